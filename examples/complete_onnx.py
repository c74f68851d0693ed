"""Complete a scan by an exported model, with numpy and onnxruntime alone.

r2flow export densify --from vlp16 --out densify.onnx
python complete_onnx.py densify.onnx scan.bin dense.bin
"""

import sys
import time

import numpy as np
import onnxruntime

model, scan, out = sys.argv[1:]
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1  # or 0: all cores
session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

# x ahead, y left, z up in metres, reflectance of [0, 1]
points = np.fromfile(scan, dtype=np.float32).reshape(-1, 4)
names = ["scan", "completed", "measured"]
for _ in range(3):  # the first run reserves memory
    start = time.perf_counter()
    image, completed, measured = session.run(names, {"points": points})
    seconds = time.perf_counter() - start
completed.tofile(out)

rows, columns = image.shape[1:]
print(f"{len(points)} points to {len(completed)} of {rows} x {columns} rays, ", end="")
print(f"{measured.sum()} of them measured, in {seconds:.2f} s")
