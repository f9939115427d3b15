from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.csv_columns import CsvLayout, read_csv_columns
from kgcp.io.files.csv_sniff import SniffedTable, sniff_table
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories.foreign_csv import recognised_table

KNOWN = {"time": ("time", "gpst"), "x": ("easting", "e"), "y": ("northing", "n")}


def sniffed(path: Path, text: str) -> SniffedTable | None:
    path.write_text(text, encoding="utf-8")
    return sniff_table(ForeignFile(path, ""), KNOWN)


@pytest.mark.parametrize(
    ("text", "separator", "decimal"),
    [
        ("GPST,E,N\n1.5,2.5,3.5\n", ",", "."),
        ("GPST;E;N\n1,5;2,5;3,5\n", ";", ","),
        ("GPST;E;N\n1.5;2.5;3.5\n", ";", "."),
        ("GPST;E;N;used\n1.5;2.5;3.5;4,12\n", ";", "."),
        ("GPST\tE\tN\n1,5\t2,5\t3,5\n", "\t", ","),
        ("GPST   E  N\n 1.5  2.5   3.5\n", " ", "."),
        ('"GPST";"E";"N"\n"1,5";"2,5";"3,5"\n', ";", ","),
        ("\ufeffsep=;\r\nGPST;E;N\r\n1,5;2,5;3,5\r\n", ";", ","),
        ("GPST;E;N\n1,5;2,5;3,5;;\n;;;;\n", ";", ","),
    ],
)
def test_what_is_sniffed_is_read(tmp_path: Path, text: str, separator: str, decimal: str) -> None:
    path = tmp_path / "a.csv"
    table = sniffed(path, text)
    assert table is not None
    assert (table.layout.separator, table.layout.decimal) == (separator, decimal)
    assert table.layout.columns == {"time": "GPST", "x": "E", "y": "N"}
    columns = read_csv_columns(path, ("time",), ("x", "y"), (), "", table.layout)
    assert columns.numbers.tolist() == [[2.5, 3.5]]
    assert table.number("x") == 2.5


@pytest.mark.parametrize(
    "text", ["", "GPST;E\n", "a,b\n1,2\n", "# GPST,E,N\n1,2,3\n", "<x>E,N</x>\n1,2\n", "\0E,N\n1,2"]
)
def test_other_files_are_no_tables(tmp_path: Path, text: str) -> None:
    assert sniffed(tmp_path / "a.csv", text) is None


def test_units_that_kgcp_does_not_take_are_not_taken(tmp_path: Path) -> None:
    table = sniffed(tmp_path / "a.csv", "GPST,E (ft),N [m]\n1,2,3\n")
    assert table is not None
    assert table.layout.columns == {"time": "GPST", "y": "N [m]"}


def test_a_column_that_is_translated_hides_one_of_the_own_name(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,x,E,y\n1,2,3,4\n", encoding="utf-8")
    layout = CsvLayout(columns={"x": "E"})
    columns = read_csv_columns(path, ("time",), ("x", "y"), (), "", layout)
    assert columns.numbers.tolist() == [[3.0, 4.0]]
    with pytest.raises(KgcpError, match="which flight"):
        read_csv_columns(path, (), ("x",), (), "", CsvLayout(columns={"x": "Ost"}))


def test_groups_of_a_trajectory_are_whole_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,lon,lat,h,heading,sdN,sdE\n1,11.5,48.1,545,90,1,1\n", encoding="utf-8")
    table = recognised_table(ForeignFile(path, ""))
    assert table is not None
    assert table.is_geographic
    assert not table.has_attitude
    assert table.table.layout.columns == {"x": "lon", "y": "lat", "z": "h"}


def test_a_line_for_excel_is_no_header_and_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("sep=,\nframe,time\na.jpg,1\nb.jpg,2,x\n", encoding="utf-8")
    assert ForeignFile(path, "").first_line == "frame,time"
    with pytest.raises(KgcpError, match=r"line 4: has 3 cells, the first line has 2"):
        read_csv_columns(path, ("frame", "time"), (), (), "")


@pytest.mark.parametrize("number", ["689.591", "5.336.213,5"])
def test_points_between_thousands_are_not_taken_for_decimals(tmp_path: Path, number: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"time;x\n1;{number}\n", encoding="utf-8")
    with pytest.raises(KgcpError, match=rf"line 2: x is '{number}', with a point, but decimals"):
        read_csv_columns(path, ("time",), ("x",), (), "", CsvLayout(";", ","))
