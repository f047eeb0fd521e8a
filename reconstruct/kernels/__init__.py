"""NVIDIA Warp kernels, each beside its plain PyTorch reference."""
