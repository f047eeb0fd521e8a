"""Benchmarks that train: speed, ablation, views."""
