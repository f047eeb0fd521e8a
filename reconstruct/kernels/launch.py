"""How Warp kernels are started: lazily, on the tensors' own device, in chunks on the CPU, or not at all.

Every kernel takes `first` as its first argument and works on element `first + tid`. On the CPU one Warp
launch is one thread, so a launch whose elements write to places of their own is cut into one chunk per core;
a launch that scatters into shared memory is not, which also keeps its sums in one order (bit-equal from run
to run). Where Warp cannot be used (no compiler backend, an unknown processor) the plain PyTorch references
take over; that is logged once.
"""

import functools
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, no_type_check

import torch
import warp as wp

CHUNK_MINIMUM = 256  # elements; below this a second thread costs more than it brings
log = logging.getLogger(__name__)


def use_warp(device: torch.device) -> bool:
    """True where Warp kernels run on `device`; False after logging once that the references are used."""
    return _ready(device.type)


def launch(
    kernel: Any, size: int, arguments: list[Any], device: torch.device, *, scatters: bool = False
) -> None:
    """Run `kernel` on elements 0 .. size-1.

    Args:
        kernel: A Warp kernel whose first argument is the index of the first element.
        size: Number of elements.
        arguments: The other arguments; torch tensors already wrapped by `array`.
        device: Where the tensors are.
        scatters: The kernel adds to places that other elements add to as well.
    """
    if size == 0:
        return
    name = "cpu" if device.type == "cpu" else str(device)
    threads = 1 if device.type != "cpu" or scatters else min(_cores(), size // CHUNK_MINIMUM)
    if threads < 2:
        wp.launch(kernel, dim=size, inputs=[0, *arguments], device=name)
        return
    kernel.module.load(
        name, block_dim=1
    )  # compile once, here: what the threads' launches would all start to do
    bounds = [size * n // threads for n in range(threads + 1)]
    jobs = [
        _pool().submit(wp.launch, kernel, dim=b - a, inputs=[a, *arguments], device=name)
        for a, b in zip(bounds[:-2], bounds[1:-1], strict=True)
    ]
    wp.launch(kernel, dim=bounds[-1] - bounds[-2], inputs=[bounds[-2], *arguments], device=name)
    for job in jobs:
        job.result()


def array(tensor: torch.Tensor, dtype: Any = None) -> Any:
    """A tensor as a Warp kernel's argument, without a copy; `dtype` a Warp vector type over the last axis."""
    return wp.from_torch(tensor.detach(), dtype=dtype, return_ctype=True)


def box_arguments(aabb: torch.Tensor, shape: tuple[int, int, int]) -> tuple[list[float], list[float]]:
    """The lower corner of a box and the factor from a position in it to a vertex index, as Python floats.

    Args:
        aabb: Corners [2, 3]; should live on the CPU (reading it from a GPU waits for that GPU).
        shape: Vertices along x, y, z; the first and last vertex lie on the box.
    """
    lo, hi = aabb.tolist()
    return lo, [(n - 1) / (b - a) for n, a, b in zip(shape, lo, hi, strict=True)]


@functools.cache
def _ready(device_type: str) -> bool:
    try:
        if hasattr(wp.config, "log_level"):
            wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
        else:  # Warp before 1.13 or so
            setattr(wp.config, "quiet", True)  # noqa: B010, unknown to this version's types
        wp.init()
        if device_type == "cuda" and not wp.is_cuda_available():
            raise RuntimeError("Warp sees no CUDA device")
        probe = torch.zeros(1, device=device_type)
        wp.launch(_probe, dim=1, inputs=[0, array(probe)], device=str(probe.device))
        if probe.item() != 1.0:
            raise RuntimeError("a probe kernel returned a wrong value")
        return True
    except Exception as error:  # whatever stops the compiler, the references still work
        log.warning(
            "Warp kernels do not run on %s (%s): using the slower PyTorch references", device_type, error
        )
        return False


@functools.cache
def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(1, _cores() - 1), thread_name_prefix="warp")


@wp.kernel(enable_backward=False)
@no_type_check
def _probe(first: int, out: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    out[first + wp.tid()] = 1.0
