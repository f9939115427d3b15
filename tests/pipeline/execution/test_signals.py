"""Signals that are held back."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from kgcp.pipeline.execution.signals import defer_interrupts


class CameError(Exception):
    """What the handler of this test raises."""


def raise_it(number: int, _: object) -> None:
    raise CameError(number)


@pytest.fixture(autouse=True)
def raising() -> Iterator[None]:
    """Let SIGTERM raise for the time of a test."""
    previous = signal.signal(signal.SIGTERM, raise_it)
    yield
    signal.signal(signal.SIGTERM, previous)


def hold(number: signal.Signals, steps: list[str]) -> None:
    with defer_interrupts():
        signal.raise_signal(number)
        with defer_interrupts():
            signal.raise_signal(number)
        steps.append("inside")
    steps.append("behind")


@pytest.mark.usefixtures("sigint_raises")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_comes_when_the_block_has_ended(number: signal.Signals) -> None:
    steps: list[str] = []
    with pytest.raises((KeyboardInterrupt, CameError)):
        hold(number, steps)
    assert steps == ["inside"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is raise_it
    if os.name != "nt":  # which has no masks
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.usefixtures("sigint_raises")
def test_an_ignored_signal_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    steps: list[str] = []
    hold(signal.SIGINT, steps)
    assert steps == ["inside", "behind"]
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_other_threads_hear_no_signals_anyway() -> None:
    def block() -> None:
        with defer_interrupts():
            steps.append("inside")

    steps: list[str] = []
    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert steps == ["inside"]
