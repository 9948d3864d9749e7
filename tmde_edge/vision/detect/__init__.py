"""Plate finders."""
