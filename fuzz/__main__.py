"""Fuzz one target after the other with atheris: `python -m fuzz --seconds 480 poses times`.

What is found lands in fuzz/found, and the tests fail until it is repaired.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path

SEEDS = Path(__file__).parent / "seeds"
FOUND = Path(__file__).parent / "found"
NAMES = sorted(folder.name for folder in SEEDS.iterdir())
_TIMEOUT_S = 5  # for one input: longer is a hang
_MEMORY_MB = 2048
_LONGEST = 16384  # bytes of one input
_INSTRUMENTED = ["kgcp", "tomllib", "json", "csv", "xml", "yaml", "PIL"]
_WORD = re.compile(rb"[A-Za-z_%][\w.:/+=-]{2,40}")


def main() -> int:
    """Run the targets that the command line names, or all; 1 if there was a finding."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="target", help="all, if none is named")
    parser.add_argument("--seconds", type=int, default=300, help="for each target")
    parser.add_argument(
        "--corpus", type=Path, help="folder that keeps what was reached, to go on from there"
    )
    if "--one" in sys.argv[1:2]:
        _fuzz(sys.argv[2], sys.argv[3:])
    options = parser.parse_args()
    if unknown := set(options.targets) - set(NAMES):
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    findings = 0
    for name in options.targets or NAMES:
        findings += _run(name, options.seconds, options.corpus)
    return 1 if findings else 0


def _run(name: str, seconds: int, corpus: Path | None) -> bool:
    """Fuzz a target in a process of its own; whether something was found."""
    with tempfile.TemporaryDirectory() as scratch:
        kept = (corpus or Path(scratch)) / name
        seeds = [SEEDS / name, FOUND / name]
        for folder in (kept, *seeds):
            folder.mkdir(parents=True, exist_ok=True)
        words = Path(scratch) / "words"
        words.write_text(_dictionary(seeds))
        command = [
            *(sys.executable, "-m", "fuzz", "--one", name),
            *(f"-max_total_time={seconds}", f"-timeout={_TIMEOUT_S}", f"-max_len={_LONGEST}"),
            *(f"-rss_limit_mb={_MEMORY_MB}", f"-dict={words}", "-print_final_stats=1"),
            f"-artifact_prefix={FOUND / name}/",
            *map(str, (kept, *seeds)),
        ]
        ran = subprocess.run(
            command, check=False, stderr=subprocess.PIPE, text=True, errors="replace"
        )
    last = [line for line in ran.stderr.splitlines() if re.match(r"#\d+\s", line)][-1:]
    print(f"{name}: {' '.join(' '.join(last).split())}", flush=True)
    if ran.returncode:
        print("\n".join(_telling(ran.stderr)), flush=True)
    return bool(ran.returncode)


def _telling(log: str) -> list[str]:
    """Return the lines about a finding: all but libFuzzer's progress."""
    return [line for line in log.splitlines() if not re.match(r"#\d+|INFO|NEW_FUNC|\s+NEW_", line)]


def _dictionary(folders: list[Path]) -> str:
    """Return the words of the seeds in libFuzzer's notation: mutations put them in."""
    words = {
        word
        for folder in folders
        for path in folder.iterdir()
        if not path.suffix.startswith((".jp", ".png", ".tif", ".webp"))
        for word in _WORD.findall(path.read_bytes())
    }
    return "".join(f'"{word.decode()}"\n' for word in sorted(words))


def _fuzz(name: str, arguments: list[str]) -> None:
    """Let atheris drive a target; does not return."""
    import atheris

    with atheris.instrument_imports(include=_INSTRUMENTED, exclude=_compiled_modules()):
        from fuzz.targets import LATE_MODULES, feed

        for module in LATE_MODULES:  # else they would be imported later, without instruments
            import_module(module)
    with tempfile.TemporaryDirectory() as folder:
        atheris.Setup([sys.argv[0], *arguments], lambda data: feed(name, data, Path(folder)))
        atheris.Fuzz()  # ends the process


def _compiled_modules() -> list[str]:
    """Return the modules with compiled functions: numba refuses those that carry instruments."""
    package = Path(__file__).parents[1] / "kgcp"
    return [
        ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for path in sorted(package.rglob("*.py"))
        if "kgcp.geometry._jit import" in path.read_text(encoding="utf-8")
    ]


if __name__ == "__main__":
    sys.exit(main())
