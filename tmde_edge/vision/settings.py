"""The `[detector]`, `[segmenter]` and `[flow]` tables."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Score = Annotated[float, Meta(gt=0, lt=1)]  # a bar that some candidates pass and some do not
PositiveInt = Annotated[int, Meta(ge=1)]


class DetectorSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which finder, where and how often it looks, and when a plate counts as seen."""

    kind: Literal["platenet", "contour", "onnx"] = "platenet"  # our network, the paper, a network of yours
    score_min: Score = 0.5  # candidates below this are not plates (strict mode)
    permissive_score_min: Score = 0.3  # the same in permissive mode
    permissive_after_frames: PositiveInt = 30  # without a plate: permissive; strict again on success
    confident_score: Fraction = 0.8  # a new plate this sure is reported at once; others when seen confirm_hits times
    confirm_hits: PositiveInt = 2  # sightings by the detector before a less sure plate is reported
    max_plates: PositiveInt = 8  # followed at once

    search_rate_hz: Positive = 10.0  # full searches a second of source time
    search_width_px: Annotated[int, Meta(ge=64, le=4096)] = 640  # full searches see the frame scaled down to this
    fovea: bool = True  # also look at the middle of the driving path at full resolution, for far plates
    fovea_width_px: Annotated[int, Meta(ge=64, le=2048)] = 384  # of that window, in source pixels
    fovea_height_px: Annotated[int, Meta(ge=64, le=2048)] = 192  # and its height
    fovea_rate_hz: Positive = 10.0  # looks through the fovea a second, at frames between the full searches
    region_margin: Positive = 1.0  # region search: the predicted box and this many plate widths round it
    region_plate_px: Positive = 96.0  # region search scales the plate to about this width (never enlarged)

    still_score_min: Score = 0.3  # the same for stills, where finder and reader are asked again before a plate is believed
    still_belief_min: Fraction = 0.5  # finder, reader and a closer look together: less is no plate in a still, and no new track
    still_beside_min: Fraction = 0.8  # the same for further plates beside a sure one
    still_second_look: bool = True  # `measure`: tiles at full resolution where the whole view shows no sure plate
    still_tiles_max: Annotated[int, Meta(ge=0, le=64)] = 12  # at most this many tiles

    lost_s: Positive = 0.5  # a track that only flow carries is dropped after this long without a detection
    blind_contrast: NotNegative = 12.0  # grey levels between darkest and brightest 2 %: less is blind

    # kind = "contour", Algorithm 1 of the paper
    a_min_px: Positive = 400.0  # smallest bounding-box area of a contour, square pixels
    max_contours: PositiveInt = 30  # the largest this many are looked at
    min_width_px: Positive = 60.0  # smallest plate, in source pixels
    min_height_px: Positive = 20.0  # and its height

    # kind = "onnx", a detector of yours
    onnx_path: str = ""  # the file
    onnx_format: Literal["yolo", "yolo-corners", "ssd-corners", "detr"] = "yolo"  # how its outputs are read
    onnx_width_px: Annotated[int, Meta(ge=0)] = 0  # input size where the graph leaves it open; 0: 640 on the longer side
    onnx_height_px: Annotated[int, Meta(ge=0)] = 0  # and its height
    onnx_mean: list[float] = []  # of three channels, 0..255, subtracted; empty: 104 117 123 (ssd-corners), else none
    onnx_scale: Positive | None = None  # multiplies after that; none: 1 (ssd-corners), else 1/255
    onnx_rgb: bool | None = None  # channel order; none: BGR (ssd-corners), else RGB
    onnx_class: Annotated[int, Meta(ge=0)] = 0  # which class is the plate, from 0
    onnx_classes: PositiveInt = 1  # how many there are (yolo-corners)
    onnx_no_object: bool = False  # detr: the last class means none (softmax); else every class has its own sigmoid
    # ssd-corners: sides of the priors at strides 8, 16, 32
    onnx_sizes_px: tuple[tuple[float, ...], ...] = ((24.0, 48.0), (96.0, 192.0), (384.0, 768.0))  # each row a level


class SegmenterSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How characters are measured."""

    kind: Literal["glyphnet", "paper"] = "glyphnet"  # our network, or the paper's Algorithm 2 (two thresholds)
    trim_k: Annotated[int, Meta(ge=0, le=10)] = 0  # the mean leaves out the k tallest and k shortest (paper: 2)
    min_characters: Annotated[int, Meta(ge=0)] = 3  # fewer than this give no character height
    platehood_min: Fraction = 0.6  # a reader that is less sure than this that it reads a plate rejects the candidate
    still_platehood_min: Fraction = 0.9  # a reader less sure of a still reads again at its own corners
    refine: bool = True  # sub-pixel plate outline in the source image


class FlowSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Lucas-Kanade tracking inside the plate and in the vehicle's rear round it."""

    enabled: bool = True  # false: every frame is measured by itself
    max_points: Annotated[int, Meta(ge=8, le=400)] = 40  # features in the plate, and as many in the ring round it
    window_px: Annotated[int, Meta(ge=5, le=41)] = 13  # side of the Lucas-Kanade window
    levels: Annotated[int, Meta(ge=0, le=5)] = 2  # pyramid levels above the source
    forward_backward_px: Positive = 0.7  # a feature that does not come back this near is dropped
    min_points: Annotated[int, Meta(ge=3)] = 6  # fewer give no prediction
    residual_max_px: Positive = 1.5  # a fit worse than this (one sigma) gives no prediction
    ring: Positive = 1.2  # width of the ring of vehicle rear, in plate heights
    carry_s: Positive = 4.0  # a plate surely seen, then hidden: so long by the vehicle's rear alone, to twice its size
    base_s: Positive = 0.2  # scale changes are reported over at least this span of source time
