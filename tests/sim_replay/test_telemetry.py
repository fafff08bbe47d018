"""telemetry.csv as spreadsheets and people leave it: read, or refused in a sentence that names the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim_replay.telemetry import COLUMNS, TelemetryError, read_telemetry


def rows() -> list[str]:
    still = "1,0,0,0,0,0,0,0,0,0,0,0,0,47.0,8.0,400.0"
    return [",".join(COLUMNS), *(f"{k * 20_000_000},{still}" for k in range(4))]


def test_the_page_on_replay_has_every_column() -> None:
    page = (Path(__file__).parents[2] / "docs" / "replay.md").read_text()
    assert [name for name in COLUMNS if f"`{name}`" not in page] == []


def write(path: Path, lines: list[str], encoding: str = "utf-8") -> Path:
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def test_a_mark_before_the_header_and_a_blank_line_at_the_end_are_passed_over(tmp_path: Path) -> None:
    plain = read_telemetry(write(tmp_path / "a.csv", rows()))
    for path in (
        write(tmp_path / "b.csv", rows(), "utf-8-sig"),
        write(tmp_path / "c.csv", [*rows(), ""]),
    ):
        told = read_telemetry(path)
        np.testing.assert_array_equal(told.t_ns, plain.t_ns)
        np.testing.assert_array_equal(told.values, plain.values)


@pytest.mark.parametrize(
    ("t_ns", "words"),
    [
        ("9" * 25, "line 3: t_ns is beyond 64 bits"),
        ('"' + "9" * 200_000 + '"', "line 3 is not CSV: field larger than"),
        ("soon", "line 3 does not hold 17 numbers"),
        ("20000000.0", "line 3 does not hold 17 numbers, t_ns a whole one"),
    ],
)
def test_a_number_that_is_none_is_told_with_its_line(tmp_path: Path, t_ns: str, words: str) -> None:
    lines = rows()
    lines[2] = f"{t_ns},{lines[2].split(',', 1)[1]}"
    path = write(tmp_path / "telemetry.csv", lines)
    with pytest.raises(TelemetryError) as error:
        read_telemetry(path)
    assert str(error.value).startswith(f"{path}: {words}")


@pytest.mark.parametrize("eastward", [(179.99999, -179.99999), (179.99999, 180.00001), (-180.00001, 180.00001)])
def test_between_two_rows_on_both_sides_of_180_degrees_it_is_there_and_not_on_the_other_side_of_the_earth(
    tmp_path: Path, eastward: tuple[float, float]
) -> None:
    """Some count longitudes from 0 to 360: MAVLink has no room for them."""
    lines = rows()[:3]
    flown = [line.replace(",8.0,", f",{lon},") for line, lon in zip(lines[1:], eastward, strict=True)]
    telemetry = read_telemetry(write(tmp_path / "telemetry.csv", [lines[0], *flown]))
    told = [telemetry.at(t_ns).lon_deg for t_ns in (0, 5_000_000, 15_000_000, 20_000_000)]
    np.testing.assert_allclose(told, [179.99999, 179.999995, -179.999995, -179.99999], atol=1e-9)


@pytest.mark.parametrize("place", ["473977000,8.0", "47.0,85456000"])
def test_places_in_another_unit_are_refused(tmp_path: Path, place: str) -> None:
    path = write(tmp_path / "telemetry.csv", [line.replace("47.0,8.0", place) for line in rows()])
    with pytest.raises(TelemetryError, match="lat_deg or lon_deg is not in degrees"):
        read_telemetry(path)
