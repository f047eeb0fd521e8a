"""Gaussian splats of a trained model: sampled from its surfaces, fitted to its pictures, moved by its motion."""
