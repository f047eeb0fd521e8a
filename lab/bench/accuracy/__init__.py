"""Calibration and clocks against references: `bench calibration`, `bench sync`."""
