"""The states of jobs and of intakes (captures and environments).

A job is queued, then running, then succeeded, failed or cancelled; a failed or cancelled job is queued again as its next attempt.
An intake receives its files, is checked, and is then ready or refused.
"""

from typing import Literal, get_args

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
IntakeState = Literal["receiving", "checking", "ready", "refused"]

QUEUED, RUNNING, SUCCEEDED, FAILED, CANCELLED = get_args(JobState)
ACTIVE, ENDED = (QUEUED, RUNNING), (SUCCEEDED, FAILED, CANCELLED)
RECEIVING, CHECKING, READY, REFUSED = get_args(IntakeState)
