"""Plate standards as data: sizes, glyph sizes, tolerances, sources."""
