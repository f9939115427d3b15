import pickle

import pytest

from kgcp.errors import KgcpError, Reason, Rejection, SettingError

ERRORS = [
    KgcpError("flight.toml: no camera; add [camera]", option="camera"),
    SettingError("fx", "-1 px", "give a positive number"),
    Rejection(Reason.POOR_FIT, "residuals of 9 sigmas"),
    Rejection(Reason.NO_CANDIDATE),
]


@pytest.mark.parametrize("error", ERRORS, ids=str)
def test_errors_can_be_pickled_for_other_processes(error: Exception) -> None:
    error.add_note("raised by a worker")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert type(copy) is type(error)
    assert (str(copy), vars(copy)) == (str(error), vars(error))
