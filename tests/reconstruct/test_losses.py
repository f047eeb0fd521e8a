"""Losses in closed form."""

import math

import pytest
import torch

from devrf.reconstruct.training.losses import (
    cycle_loss,
    entropy_loss,
    flow_loss,
    opacity_loss,
    per_point_loss,
    rendering_loss,
)


def test_rendering_loss_is_the_mean_over_channels_and_opacity_loss_compares_with_the_matte() -> None:
    assert rendering_loss(torch.tensor([[0.0, 0, 0.6]]), torch.zeros(1, 3)) == pytest.approx(0.12)
    assert opacity_loss(torch.tensor([0.2, 1.0]), torch.tensor([0.7, 0.0])) == pytest.approx(0.005)


def test_cycle_loss_is_half_the_squared_distance() -> None:
    x = torch.zeros(2, 3)
    assert cycle_loss(x, torch.tensor([[3.0, 4, 0], [0, 0, 0]])) == pytest.approx(6.25)
    assert cycle_loss(x[:0], x[:0]) == 0


def test_flow_loss_counts_valid_samples_only() -> None:
    moved, target = torch.tensor([[1.0, 2], [9.0, 9]]), torch.zeros(2, 2)
    weights, ones = torch.tensor([0.5, 1.0]), torch.ones(2)
    assert flow_loss(moved, target, weights, torch.tensor([1.0, 0.0]), ones) == pytest.approx(0.75)
    assert flow_loss(moved, target, weights, torch.tensor([0.0, 0.0]), ones) == 0
    # 0.75 of confidence 1 and 9 of confidence 1/4: (1.5 + 18 / 4) / (2 * 1.25)
    assert flow_loss(moved, target, weights, torch.tensor([1.0, 0.25]), ones) == pytest.approx(2.4)
    # pictures that contradict the second take its share, and give it to nobody
    agreement = torch.tensor([1.0, 0.0])
    assert flow_loss(moved, target, weights, ones, agreement) == pytest.approx(0.375)


def test_flow_loss_ignores_points_behind_the_camera_that_are_not_valid() -> None:
    moved = torch.tensor([[float("nan"), 0], [1.0, 0]])
    loss = flow_loss(moved, torch.zeros(2, 2), torch.ones(2), torch.tensor([0.0, 1.0]), torch.ones(2))
    assert loss == pytest.approx(0.5)


def test_entropy_is_largest_halfway_and_finite_at_the_ends() -> None:
    assert entropy_loss(torch.tensor([0.5])) == pytest.approx(math.log(2))
    left = torch.tensor([0.0, 1.0], requires_grad=True)
    loss = entropy_loss(left)
    loss.backward()
    assert 0 <= loss < 1e-4 and left.grad is not None and torch.isfinite(left.grad).all()


def test_per_point_loss_does_not_reach_the_weights() -> None:
    weights = torch.tensor([0.5, 0.25], requires_grad=True)
    colours = torch.tensor([[1.0, 0, 0], [0, 0, 0]], requires_grad=True)
    loss = per_point_loss(weights, colours, torch.zeros(1, 3), torch.tensor([0, 0]))
    loss.backward()
    assert loss.item() == pytest.approx(0.5)
    assert weights.grad is None
