"""NMEA sentences: speed, and what is no speed."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmde_edge.canbus.gps import gps_frame, speed_from_frame, speed_from_nmea

KNOT = 1852 / 3600


def sentence(body: str) -> str:
    total = 0
    for char in body:
        total ^= ord(char)
    return f"${body}*{total:02X}\r\n"


def test_sentences_from_the_standard() -> None:
    rmc = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
    assert speed_from_nmea(rmc) == pytest.approx(22.4 * KNOT)
    assert speed_from_nmea("$GPVTG,054.7,T,034.4,M,005.5,N,010.2,K*48") == pytest.approx(5.5 * KNOT)
    assert speed_from_nmea(sentence("GNRMC,1,A,1,N,1,E,10.0,,1,,,D")) == pytest.approx(10 * KNOT)


@pytest.mark.parametrize(
    "text",
    [
        "$GPRMC,123519,A,4807.038,N,01131.000,E,022.5,084.4,230394,003.1,W*6A",  # checksum
        sentence("GPRMC,123519,V,,,,,22.4,,230394,,,N"),  # no fix
        sentence("GPVTG,,T,,M,5.0,N,,K,N"),  # no fix
        sentence("GPRMC,123519,A,1,N,1,E,,084.4,230394"),
        sentence("GPRMC,123519,A,1,N,1,E,nan,084.4,230394"),
        sentence("GPRMC,123519,A,1,N,1,E,9999,084.4,230394"),
        sentence("GPRMC,123519,A,1,N,1,E,-3,084.4,230394"),
        sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),
        "$GPRMC*ZZ", "$", "", "garbage",
    ],
)  # fmt: skip
def test_what_is_no_speed(text: str) -> None:
    assert speed_from_nmea(text) is None


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=90))
def test_no_line_breaks_it(text: str) -> None:
    for line in (text, sentence("GPRMC," + text), sentence("GPVTG," + text)):
        speed = speed_from_nmea(line)
        assert speed is None or 0 <= speed <= 150


@given(st.floats(0, 150))
def test_the_inside_frame_carries_the_speed(speed: float) -> None:
    assert speed_from_frame(gps_frame(0, speed)) == pytest.approx(speed, abs=0.0005)
