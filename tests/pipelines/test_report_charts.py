"""The report's drawings in closed form: axes, lines, colours of flow, frustums."""

import re

import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.pipelines.report.charts import Series, line_chart, ticks
from devrf.pipelines.report.pictures import flow_picture
from devrf.pipelines.report.space import frustum

WIDTH, HEIGHT = 48, 36


def test_ticks_are_round_and_enclose():
    for low, high in [(0.0, 1.0), (-3.2, 17.9), (21.3, 21.9), (0.0, 0.0), (1e-7, 3e-7), (5.0, 123456.0)]:
        found = ticks(low, high, 5)
        assert found[0] <= low + 1e-12 and found[-1] >= high - 1e-12
        assert 2 <= len(found) <= 8
        assert np.allclose(np.diff(found), found[1] - found[0])


def test_chart_places_points_where_the_axes_say():
    html = line_chart([Series("a", [0.0, 10.0], [0.0, 1.0])], "x", "y")
    path = re.search(r'class="line".*?d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)"', html)
    assert path is not None
    x0, y0, x1, y1 = map(float, path.groups())
    label = {
        m[3]: (float(m[1]), float(m[2]))
        for m in re.finditer(r'x="([\d.]+)" y="([\d.]+)"[^>]*>([\d.]+)<', html)
    }
    assert label["0"][0] == pytest.approx(x0) and label["10"][0] == pytest.approx(x1)
    assert label["0.0"][1] - 4 == pytest.approx(y0) and label["1.0"][1] - 4 == pytest.approx(y1)


def test_decades_are_equally_wide_on_a_logarithmic_axis():
    html = line_chart([Series("a", [1.0, 10.0, 100.0, 0.0], [0.0, 1.0, 2.0, 3.0])], "x", "y", log_x=True)
    path = re.search(r'class="line".*?d="M([\d.]+) [\d.]+L([\d.]+) [\d.]+L([\d.]+) [\d.]+"', html)
    assert path is not None  # what is not positive has no place
    x0, x1, x2 = map(float, path.groups())
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2) and ">100<" in html


def test_gaps_break_a_line_and_long_ones_keep_their_spikes():
    gap = line_chart([Series("a", [0.0, 1.0, 2.0, 3.0], [1.0, float("nan"), 1.0, 2.0])], "x", "y")
    path = re.search(r'class="line"[^>]* d="([^"]*)"', gap)
    assert path is not None and path.group(1).count("M") == 2
    y = np.zeros(20_000)
    y[12_345] = 1.0
    html = line_chart([Series("a", np.arange(20_000.0).tolist(), y.tolist())], "x", "y")
    heights = [float(m) for m in re.findall(r"L[\d.]+ ([\d.]+)", html)]
    assert len(heights) < 1000 and min(heights) == pytest.approx(10.0)  # the top margin: the spike is there


def test_flow_colours_are_directions():
    flow = np.array([[[4.0, 0.0], [0.0, 4.0], [-4.0, 0.0], [0.0, 0.0]]], np.float32)
    picture = flow_picture(flow, np.array([[True, True, True, False]]), 4.0)
    expected = [[255, 0, 0], [128, 255, 0], [0, 255, 255], [120, 120, 120]]
    np.testing.assert_allclose(picture[0], expected, atol=1)  # rounding


def test_frustum_corners_project_to_the_picture_corners():
    K = np.array([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]])
    camera = Camera(
        WIDTH, HEIGHT, K, np.column_stack([np.eye(3), [0.3, -0.2, 1.0]]), np.array([0.05, 0, 0, 0, 0])
    )
    corners = frustum(camera, 0.5)
    np.testing.assert_allclose(
        camera.project(corners), [[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], atol=1e-6
    )
    np.testing.assert_allclose(
        (corners @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3])[:, 2], 0.5
    )
