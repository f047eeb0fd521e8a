"""Where a run trains, and how much of a GPU's memory it may take."""

from devrf.capture.system.amounts import GB
from devrf.capture.system.errors import InputError
from devrf.pipelines.config.words import unknown_word

DEVICES = ("auto", "cpu", "cuda")


def resolve_device(wish: str, gpu_memory_gb: float | None = None) -> str:
    """ "cpu" or "cuda" for --device.

    Args:
        wish: auto, cpu or cuda.
        gpu_memory_gb: Most of a GPU's memory to take; what would need more then ends with an error of its own
            instead of taking it from other programs.
    Raises:
        InputError: The device is not there.
    """
    check_device(wish)
    if wish == "cpu":
        return "cpu"
    import torch

    if torch.cuda.is_available():
        if gpu_memory_gb is not None:
            there = torch.cuda.get_device_properties(torch.cuda.current_device()).total_memory
            torch.cuda.set_per_process_memory_fraction(min(1.0, gpu_memory_gb * GB / there))
        return "cuda"
    if wish == "cuda":
        raise InputError("gpu-missing", "--device cuda: PyTorch finds no GPU here; use --device cpu, or auto")
    return "cpu"


def check_device(wish: str) -> None:
    """Refuse a word that --device does not know.

    Raises:
        InputError: It is not auto, cpu or cuda.
    """
    if wish not in DEVICES:
        raise unknown_word("--device", wish, DEVICES)
