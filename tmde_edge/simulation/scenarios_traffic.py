"""Scenarios of traffic in which nothing, or nothing yet, is to be warned of."""

from __future__ import annotations
