#!/usr/bin/env bash
# onnx 1.19.1's reference evaluator does not run a Scan with two states and one scanned input.
#
# The operator takes N states and M scanned inputs. The reference hands as many states to the body
# as there are scanned inputs, so the second state is missing, and it raises RuntimeError.
# onnxruntime runs the same model. Who checks an exported search along the rows of a range image
# against the reference meets this: its states are offsets and the angles between the rows.
#
# The model sums and multiplies 1, 2, 3 in two states. Prints versions, the sums by onnxruntime and
# the reference's error; exits with 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    onnx==1.19.1 onnxruntime==1.23.2 "numpy<2.4"
cd "$folder"
venv/bin/python - <<'END'
import sys

import numpy as np
import onnx
import onnxruntime
from onnx.parser import parse_model
from onnx.reference import ReferenceEvaluator

print("onnx", onnx.__version__, "onnxruntime", onnxruntime.__version__)
model = parse_model("""
<ir_version: 10, opset_import: ["": 18]>
sums (float[1] a, float[1] b, float[3, 1] x) => (float[1] sum, float[1] product, float[3, 1] seen) {
  sum, product, seen = Scan <num_scan_inputs = 1, body = step (
    float[1] a_in, float[1] b_in, float[1] one
  ) => (float[1] a_out, float[1] b_out, float[1] here) {
    a_out = Add (a_in, one)
    b_out = Mul (b_in, one)
    here = Identity (one)
  }> (a, b, x)
}
""")
onnx.checker.check_model(model)
given = {
    "a": np.zeros(1, np.float32),
    "b": np.ones(1, np.float32),
    "x": np.array([[1], [2], [3]], np.float32),
}
session = onnxruntime.InferenceSession(model.SerializeToString())
total, product, _ = session.run(None, given)
print("onnxruntime:", total, product)
try:
    said = str(ReferenceEvaluator(model).run(None, given))
except RuntimeError as error:
    said = str(error).split(" in known results")[0]
print("reference:", said)
sys.exit([*total, *product] != [6, 6] or said != "Unable to find input 'b_in'")
END
