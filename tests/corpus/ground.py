"""A sound flight, small and quick, in which each case of the corpus plants its lie."""

from __future__ import annotations

import hashlib
import io
import resource
import signal
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import cv2
import numpy as np
import pyarrow.parquet as pq
from click.testing import CliRunner, Result
from PIL import Image

from kgcp.cli import main
from kgcp.errors import Reason
from kgcp.geometry.arrays import GreyArray
from kgcp.io.tables.columns import time_cell
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import write_table
from tests.flight_toml import RING_A

WIDTH, HEIGHT = 64, 48
LIMIT_S, _PATIENCE = 5.0, 12.0
GIGABYTE = 1 << 30
_MEMORY = GIGABYTE // 2  # that one command may take more than the process has

NAME = "flight"
TOML = f"""\
name = "lies"
crs = "EPSG:25832"
[frames]
folder = "frames"
[camera]
width = {WIDTH}
height = {HEIGHT}
fx = 100.0
fy = 100.0
cx = 31.0
cy = 24.0
{RING_A}[vehicle]
trajectory = "vehicle.csv"
lever_arm_m = [-0.8, 0.15, -1.95]
[reference]
poses = "reference.csv"
"""
VEHICLE = """\
time,x,y,z,roll_deg,pitch_deg,heading_deg
2026-06-16T08:15:00Z,689591.0,5336213.0,545.0,0.1,0.2,10.0
2026-06-16T08:15:01Z,689592.0,5336218.0,545.0,0.1,0.2,11.0
2026-06-16T08:15:02Z,689593.0,5336223.0,545.0,0.1,0.2,12.0
"""
REFERENCE = """\
frame,x,y,z,omega_deg,phi_deg,kappa_deg
sound.png,689592.0,5336218.0,560.0,0.0,0.0,0.0
"""
TIMES = "frame,time\nsound.png,2026-06-16T08:15:01Z\n"

SEEN = "no_candidate"  # a frame that was read, and shows nothing
BROKEN, WRONG = Reason.DECODE_FAILED.value, Reason.WRONG_SIZE.value


@dataclass(frozen=True, slots=True)
class Case:
    """One lie, and what it must come to.

    Attributes
    ----------
    name : str
    plant : callable
        Puts the lie into the folder of a sound flight.
    words : str
        In the one line of error; empty: the command succeeds.
    rows : mapping of str
        Of `kgcp detect`: frame to reason, beside the sound frame's.
    command : tuple of str
        What is run, but for the flight, for which `{flight}` stands.
    is_huge : bool
        Whether the memory is limited meanwhile.
    absent : tuple of bytes
        What no page among the results may hold.
    """

    name: str
    plant: Callable[[Path], object]
    words: str = ""
    rows: Mapping[str, str] = field(default_factory=dict)
    command: tuple[str, ...] = ("detect", "--jobs", "0", "--no-guided")
    is_huge: bool = False
    absent: tuple[bytes, ...] = ()


def texture(dtype: type[np.unsignedinteger] = np.uint8) -> GreyArray:
    """A frame of smooth noise."""
    noise = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 1, (HEIGHT, WIDTH)), (0, 0), 2.0)
    return (noise * np.iinfo(dtype).max).astype(dtype)


def encoded(suffix: str, image: np.ndarray | None = None, *flags: int) -> bytes:
    """An image file by OpenCV, of any depth and channels."""
    is_whole, data = cv2.imencode(suffix, texture() if image is None else image, flags)
    assert is_whole
    return data.tobytes()


def saved(form: str, image: Image.Image | None = None, **options: object) -> bytes:
    """An image file by Pillow."""
    stream = io.BytesIO()
    (Image.fromarray(texture()) if image is None else image).save(stream, form, **options)
    return stream.getvalue()


def sound_flight(around: Path) -> Path:
    """Make a sound flight, and other people's files around it."""
    flight = around / NAME
    (flight / "frames").mkdir(parents=True)
    (flight / "frames" / "sound.png").write_bytes(encoded(".png"))
    for name, text in (
        *(("flight.toml", TOML), ("vehicle.csv", VEHICLE)),
        *(("reference.csv", REFERENCE), ("frames.csv", TIMES)),
    ):
        (flight / name).write_text(text)
    write_detections(flight / "kgcp" / "detections.parquet")
    elsewhere = around / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious.txt").write_text("not kgcp's\n")
    (elsewhere / "other.png").write_bytes(encoded(".png"))
    return flight


def write_detections(path: Path, settings: str = "{}", **cells: object) -> None:
    """Write a table of one measured row, in which some cells may be others."""
    words: dict[str, object] = {
        "frame": "sound.png",
        "target": "A",
        "shape": "coded",
        "scale_used": "A",
        "status": "measured",
    }
    pose = {"tx_m": 0.0, "ty_m": 0.0, "tz_m": 15.0, "qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
    found = {"x_px": 31.0, "y_px": 24.0, "distance_m": 15.0, "score": 0.9}
    row: dict[str, object] = {column.name: None for column in DETECTION_COLUMNS}
    row |= words | pose | found
    row |= {"instance": 0, "reason": "", "time": time_cell(1781597701.0)} | cells
    write_table(path, DETECTION_COLUMNS, [row], {"settings": settings})


def sparse(path: Path, head: bytes = b"") -> None:
    """Write a file of a gigabyte that takes no space: what follows its head is zeros."""
    with path.open("wb") as stream:
        stream.write(head)
        stream.truncate(GIGABYTE)


def run(case: Case, flight: Path) -> Result:
    """Run a case's command, within its limits of time and memory."""
    command, *options = (word.format(flight=flight) for word in case.command)
    with _at_most_seconds(LIMIT_S), _at_most_bytes(_MEMORY if case.is_huge else None):
        return CliRunner().invoke(main, (command, str(flight), *options))


def state(around: Path) -> Mapping[str, object]:
    """What is around the results' folder: names, kinds, sizes, contents."""
    return dict(_state(around, around / NAME / "kgcp"))


def reasons(flight: Path) -> Mapping[str, str]:
    """The table's reasons by frame."""
    table = pq.read_table(flight / "kgcp" / "detections.parquet").to_pydict()
    return dict(zip(table["frame"], table["reason"], strict=True))


def _state(folder: Path, results: Path) -> Iterator[tuple[str, object]]:
    for path in sorted(folder.iterdir()):
        status = path.lstat()
        content: object = None
        if stat.S_ISLNK(status.st_mode):
            content = path.readlink()
        elif stat.S_ISREG(status.st_mode) and status.st_size < 1 << 20:
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        is_results = path == results and not path.is_symlink()
        if not is_results:
            size = status.st_size if stat.S_ISREG(status.st_mode) else 0
            yield ascii(str(path)), (stat.S_IFMT(status.st_mode), size, content)
        if stat.S_ISDIR(status.st_mode) and not is_results:
            yield from _state(path, results)


@contextmanager
def _at_most_seconds(limit_s: float) -> Iterator[None]:
    """Limit the processor's time, which others on the machine do not take; waiting less closely."""
    limits = (
        (signal.ITIMER_PROF, signal.SIGPROF, limit_s),
        (signal.ITIMER_REAL, signal.SIGALRM, _PATIENCE * limit_s),
    )
    before = [signal.signal(number, _overdue) for _, number, _ in limits]
    for timer, _, seconds in limits:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (timer, number, _), handler in zip(limits, before, strict=True):
            signal.setitimer(timer, 0.0)
            signal.signal(number, handler)


def _overdue(number: int, _frame: FrameType | None) -> None:
    raise AssertionError(f"took too long: {signal.strsignal(number)}")


@contextmanager
def _at_most_bytes(more: int | None) -> Iterator[None]:
    """Limit the address space to what the process has now, and some more."""
    if more is None:
        yield
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + more
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
