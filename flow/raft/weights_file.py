"""Files of weights by torch, as data only: no code in them is run, and they unpack to no more than weights can have."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch

from devrf.capture.system.errors import FlowError
from devrf.capture.system.limits import WEIGHT_BYTES, check_bytes


def read_weights(path: Path) -> object:
    """What a `.pth` holds.

    Raises:
        CaptureError: It is larger than any network's weights, packed or unpacked.
        FlowError: One of its tensors claims to be.
        Exception: What torch's reader raises of other files depends on their bytes.
    """
    check_bytes(path, WEIGHT_BYTES)
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_bytes(path, WEIGHT_BYTES, sum(entry.file_size for entry in archive.infolist()))
    found = torch.load(path, map_location="cpu", weights_only=True)
    for name, value in found.items() if isinstance(found, Mapping) else ():
        # A view of one number may claim any shape.
        if isinstance(value, torch.Tensor) and value.numel() * value.element_size() > WEIGHT_BYTES:
            shape = list(value.shape)
            text = f"{path}: {name} has shape {shape}, more than any network; get it again"
            raise FlowError("file-damaged", text)
    return found
