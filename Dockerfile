# CPU:   docker build -t r2flow .
# CUDA:  docker build -t r2flow:cuda --build-arg BASE=pytorch/pytorch:2.8.0-cuda12.8-cudnn9-runtime .
# Run:   docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" r2flow sample --out scans      (CUDA: --gpus all)
ARG BASE=python:3.12-slim
FROM ${BASE}

# Extras of r2flow, as "[formats,export]".
ARG EXTRAS=""
ENV PIP_NO_CACHE_DIR=1 \
    PIP_BREAK_SYSTEM_PACKAGES=1 \
    HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib

# A base without torch gets the CPU's, which is a tenth of the size.
RUN python -c "import torch" 2>/dev/null \
    || python -m pip install "torch>=2.6,<2.14" --index-url https://download.pytorch.org/whl/cpu

COPY . /opt/r2flow
RUN python -m pip install "/opt/r2flow${EXTRAS}" && r2flow --version

WORKDIR /work
ENTRYPOINT ["r2flow"]
CMD ["--help"]
