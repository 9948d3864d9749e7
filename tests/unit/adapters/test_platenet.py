"""The packaged plate network on drawn plates."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tmde_edge.adapters.detectors.platenet import MODEL_PATH, PlateNet, prepare
from tmde_edge.errors import ModelError
from tmde_edge.simulation.plate_face import FaceSpec, GlyphSpec, render_face


@pytest.fixture(scope="module")
def net() -> PlateNet:
    return PlateNet(threads=1)


def scene(plate_width_px: int, at_px: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A 640x360 picture of a grey car's rear with one plate; its top left corner's pixel is at_px. And the plate's corners."""
    glyphs = tuple(
        GlyphSpec(char=c, left_mm=-190 + 58 * i, top_mm=-37.5, width_mm=44, height_mm=75, stroke_mm=10)
        for i, c in enumerate("KAF4718")
    )
    spec = FaceSpec(width_mm=520, height_mm=110, glyphs=glyphs, background_bgr=(235, 240, 240), ink_bgr=(15, 15, 15), border_mm=4)
    image = np.random.default_rng(3).normal(95, 4, (360, 640, 3)).clip(0, 255).astype(np.uint8)
    x, y = at_px
    w, h = plate_width_px, round(plate_width_px * 110 / 520)
    cv2.rectangle(image, (x - w, y - w), (x + 2 * w, y + w), (70, 50, 45), -1)
    cv2.rectangle(image, (x - w // 6, y - h // 2), (x + w + w // 6, y + h + h // 2), (45, 32, 30), -1)
    image[y:y + h, x:x + w] = cv2.resize(render_face(spec, 1.0), (w, h), interpolation=cv2.INTER_AREA)
    corners = np.array([(x, y), (x + w, y), (x + w, y + h), (x, y + h)]) - 0.5
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6), np.uint8), corners


@pytest.mark.parametrize(("width_px", "scale"), [(40, 1.0), (90, 0.5), (150, 1.0), (150, 0.5)])
def test_a_drawn_plate_is_found_where_it_is(net: PlateNet, width_px: int, scale: float) -> None:
    image, truth = scene(width_px, (260, 170))
    best = net.detect(image, scale=scale)[0]
    assert best.score > 0.4
    assert np.abs(best.corners_px - truth).max() < 0.12 * width_px


def test_a_region_and_grey_give_source_pixels(net: PlateNet) -> None:
    image, truth = scene(80, (400, 200))
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    best = net.detect(grey, region_px=(301, 97, 613, 331), scale=1.0)[0]
    assert np.abs(best.corners_px - truth).max() < 8
    assert net.detect(image, region_px=(0, 0, 200, 100), scale=1.0, score_min=0.5) == []


def test_wrong_use_is_an_error(net: PlateNet) -> None:
    image, _ = scene(80, (400, 200))
    with pytest.raises(ValueError, match="region"):
        net.detect(image, region_px=(600, 0, 700, 100), scale=1.0)
    with pytest.raises(ValueError, match="scale"):
        net.detect(image, scale=0.0)
    with pytest.raises(ValueError, match="score_min"):
        net.detect(image, score_min=1.0)


def test_a_network_that_gives_nan_is_broken_and_no_empty_road(net: PlateNet, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def run(self, names: None, feed: dict[str, NDArray[np.uint8]]) -> list[NDArray[np.float32]]:
            (image,) = feed.values()
            return [np.full((1, 9, image.shape[1] // s, image.shape[2] // s), np.nan, np.float32) for s in (4, 16)]

    monkeypatch.setattr(net, "_session", Broken())
    with pytest.raises(ModelError, match=r"platenet\.onnx: the network's scores are not finite; install"):
        net.detect(scene(80, (400, 200))[0], scale=1.0)


def test_padding_keeps_the_picture_at_the_top_left() -> None:
    crop = np.full((90, 161, 3), 200, np.uint8)
    fed, (sx, sy) = prepare(crop, 0.5)
    assert fed.shape == (1, 64, 96, 3)
    assert fed.sum() == 200 * 3 * round(90 * 0.5) * round(161 * 0.5)
    assert sx == pytest.approx(80 / 161)
    assert sy == pytest.approx(45 / 90)


def test_a_missing_or_broken_file_is_a_model_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="missing"):
        PlateNet(model_path=tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(MODEL_PATH.read_bytes()[:5000])
    with pytest.raises(ModelError, match="cannot load"):
        PlateNet(model_path=broken)
