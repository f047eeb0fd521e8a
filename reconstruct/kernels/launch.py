"""How Warp kernels are started: lazily, on the tensors' own device, in chunks on the CPU, or not at all.

Every kernel takes `first` as its first argument and works on element `first + tid`. On the CPU one Warp
launch is one thread, so a launch whose elements write to places of their own is cut into one chunk per core
(at most `OMP_NUM_THREADS`); a launch that scatters into shared memory is not, unless it brings a copy of that
memory for each thread. Either way sums keep one order, whatever the number of cores (bit-equal from run to
run). Where Warp cannot be used (no compiler backend, an unknown processor) the plain PyTorch
references take over; that is logged once.
"""

import contextlib
import functools
import logging
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, no_type_check

import torch
import warp as wp

from devrf.capture.system.cores import usable_cores

# of memory that CPU threads scatter into; each is a grid to keep, and to read in every step
SCATTER_COPIES = 2
ODD = 17  # entries more in a row: rows whose length is a power of two share a processor's few cache lines
CHUNK_MINIMUM = 256  # elements; below this a second thread costs more than it brings
log = logging.getLogger(__name__)


def use_warp(device: torch.device) -> bool:
    """True where Warp kernels run on `device`; False after logging once that the references are used."""
    return _ready(device.type)


def launch(
    kernel: Any, size: int, arguments: list[Any], device: torch.device, *, into: list[Any] | None = None
) -> None:
    """Run `kernel` on elements 0 .. size-1.

    Args:
        kernel: A Warp kernel whose first argument is the index of the first element.
        size: Number of elements.
        arguments: The other arguments; torch tensors already wrapped by `array`.
        device: Where the tensors are.
        into: What the kernel scatters into, its last argument: one copy for every part of the elements.
    """
    if size == 0:
        return
    name = "cpu" if device.type == "cpu" else str(device)
    if into is not None:
        last = [[copy] for copy in into]
    else:
        parts = min(_cores(), size // CHUNK_MINIMUM) if device.type == "cpu" else 1
        last = [[]] * max(1, parts)
    if len(last) == 1:
        wp.launch(kernel, dim=size, inputs=[0, *arguments, *last[0]], device=name)
        return
    # compile once, here: what the threads' launches would all start to do
    kernel.module.load(name, block_dim=1)
    bounds = [size * n // len(last) for n in range(len(last) + 1)]

    def part(n: int) -> None:
        if bounds[n + 1] > bounds[n]:
            inputs = [bounds[n], *arguments, *last[n]]
            wp.launch(kernel, dim=bounds[n + 1] - bounds[n], inputs=inputs, device=name)

    beside = len(last) - 1 if _cores() > 1 else 0  # a process with one core to itself leaves the others alone
    jobs = [_pool().submit(part, n) for n in range(beside)]
    for n in range(beside, len(last)):
        part(n)
    for job in jobs:
        job.result()


def copies_for(device: torch.device) -> int:
    """Copies of memory to scatter into: one on a GPU, whose additions are atomic."""
    return SCATTER_COPIES if device.type == "cpu" else 1


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
        with contextlib.nullcontext() if torch.cuda.is_available() else _native_silence():
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


@contextlib.contextmanager
def _native_silence() -> Iterator[None]:
    """Without stderr, Python's and C's: Warp's native part warns there of a missing GPU, which is no fault."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_cores = functools.cache(usable_cores)


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(1, _cores() - 1), thread_name_prefix="warp")


@wp.kernel(enable_backward=False)
@no_type_check
def _probe(first: int, out: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    out[first + wp.tid()] = 1.0
