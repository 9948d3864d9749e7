"""Marks the tests that must also hold on another processor (`scripts/arm64-test`): imports, vision on small images,
estimation, CAN, networks. Left out is what only repeats them through the program or takes long where code is emulated."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("untimed", deadline=None)  # how fast a machine is, is no property of the code
settings.load_profile("untimed")

PORTABLE = (
    "alerts",
    "canbus",
    "estimation/test_estimation.py",
    "geometry",
    "plates",
    "pose/test_compensate.py",
    "pose/test_horizon.py",
    "pose/test_lanes.py",
    "ranging/test_cover.py",
    "ranging/test_cues_and_budget.py",
    "ranging/test_depth_scale.py",
    "ranging/test_track_scale.py",
    "tracking",
    "vision/detect",
    "vision/segment/test_glyph_crop.py",
    "vision/segment/test_glyph_decode.py",
    "vision/test_paper_table1.py",
    "vision/test_rectify.py",
    "vision/test_refine.py",
    "vision/test_search_and_sighting.py",
    "adapters/test_can_logs.py",
    "adapters/test_depth.py",
    "adapters/test_glyphnet.py",
    "adapters/test_horizonnet.py",
    "adapters/test_onnx_plugin.py",
    "adapters/test_platenet.py",
    "adapters/test_v4l2.py",
    "app/test_drive_log.py",
    "app/test_models.py",
    "test_config.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        inside = item.path.relative_to(here) if item.path.is_relative_to(here) else None
        if inside is not None and any(inside.is_relative_to(part) for part in PORTABLE):
            item.add_marker(pytest.mark.portable)
