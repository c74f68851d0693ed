import hashlib
import struct

import torch

from r2flow.hashing import state_hash


def test_the_hash_of_a_state_is_of_names_shapes_types_and_bytes():
    state = {"b": torch.tensor([1.0, 2.0]).bfloat16(), "a": torch.tensor([[1, 2], [3, 4]]).T, "c": torch.tensor(0.5)}
    named = (
        b"a (2, 2) torch.int64" + struct.pack("<4q", 1, 3, 2, 4)
        + b"b (2,) torch.bfloat16" + bytes.fromhex("803f0040")
        + b"c () torch.float32" + struct.pack("<f", 0.5)
    )  # fmt: skip
    assert state_hash(state) == hashlib.sha256(named).hexdigest()
    assert state_hash(dict(reversed(state.items())), b"kitti") == hashlib.sha256(b"kitti" + named).hexdigest()
