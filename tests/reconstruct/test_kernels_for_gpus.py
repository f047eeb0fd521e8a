"""Kernels compile for GPUs that are not here, and need no more registers than these have: what spills is slow."""

import re
import subprocess
import sys
from importlib.metadata import files
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from devrf.reconstruct.kernels import (
    adam,
    background,
    composite,
    composite_layers,
    launch,
    layers,
    march,
    occupancy,
    quad,
    splat,
    trilinear,
)

ARCHITECTURES = [80, 90, 120]  # A100, H100 and H200, RTX 50
CHANNELS = (1, 3, 4, 9, 12)  # of grids: density, colours, surroundings, motion, features
MOST_REGISTERS = 128
USED = re.compile(r"Function (\w+):\s+REG:(\d+) STACK:(\d+) SHARED:\d+ LOCAL:(\d+)")


def modules() -> dict[str, Any]:
    """All modules of kernels, those that are made for a number of channels too."""
    plain = (adam, background, composite, launch, layers, march, occupancy, quad, splat)
    found = {m.__name__.split(".")[-1]: wp.get_module(m.__name__) for m in plain}
    for n in CHANNELS:
        _, forward, backward = trilinear._kernels(n)
        made = {"forward": forward, "backward": backward, "masked": adam._masked(n)[1]}
        if n in (3, 12):
            _, made["composited"], made["adjoint"], made["places"] = composite_layers._kernels(n)
        found |= {f"{name}_{n}": kernel.module for name, kernel in made.items()}
    return found


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="the project asks for cuobjdump on Linux alone")
def test_no_kernel_spills_on_a_gpu(tmp_path: Path) -> None:
    listed = files("nvidia-cuda-cuobjdump") or []
    program = next(str(f.locate()) for f in listed if f.stem == "cuobjdump")
    seen, bad = 0, []
    for name, module in modules().items():
        compiled = wp.compile_aot_module(
            module, arch=ARCHITECTURES, module_dir=str(tmp_path / name), use_ptx=False
        )
        for path in compiled:
            said = subprocess.run(
                [program, "--dump-resource-usage", str(path)], capture_output=True, text=True, check=True
            )
            for kernel, registers, stack, local in USED.findall(said.stdout):
                seen += 1
                if int(registers) > MOST_REGISTERS or (stack, local) != ("0", "0"):
                    bad.append(f"{path}: {kernel} {registers} registers, stack {stack}, local {local}")
    assert seen > 30 * len(ARCHITECTURES) and not bad
