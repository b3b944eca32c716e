"""Found by Python at its start where this folder is on PYTHONPATH: makes the frames of a worker's jobs do what SABOTAGE says.

kill  end the process by SIGKILL, as want of memory would      hang  stand still
slow  take a tenth of a second for each frame; and before the ninth wait for a file of the name GATE, where that is given
long  half a second in jobs of 300 frames and more and in the first attempt of jobs of the name `slow`, and a tenth in those of 60 frames
      and more: a worker is then busy without keeping the other tests from the processor

With PIECES the bands and batches of solves are small, and each takes about that many seconds more. The first waits until a second worker
has begun one of the same job, so that neither does all of them before the other has come: TOGETHER is the folder in which each leaves a
file, in a folder of the job.

Only the process of a worker is changed: the others that begin with it, which watch it, do no jobs and are not kept waiting for its modules.
"""

import os
import signal
import sys
import threading
import time


def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def hang(*_):
    threading.Event().wait()


class Slow:
    made = 0
    """Frames that this process has made."""

    def __init__(self, inner, frame_s=0.1):
        self._inner, self._frame_s, self._stage = inner, frame_s, ""

    def stage(self, name, total):
        self._stage = name
        self._inner.stage(name, total)

    def advance(self, done):
        time.sleep(self._frame_s)
        self._inner.advance(done)
        Slow.made += self._stage == "frames"
        while Slow.made == 8 and "GATE" in os.environ and not os.path.exists(os.environ["GATE"]):
            time.sleep(0.05)


def slow(request, chunk, files):
    relight(request, chunk, files._replace(progress=Slow(files.progress)))


def slow_if_long(request, chunk, files):
    frames = len(frame_numbers(request.options.frames, 1))
    frame_s = 0.5 if frames >= 300 or (request.name == "slow" and files.job.attempt == 1) else 0.1 if frames >= 60 else 0.0
    relight(request, chunk, files._replace(progress=Slow(files.progress, frame_s)) if frame_s else files)


is_worker = "--multiprocessing-fork" in sys.orig_argv  # as Python calls a process that multiprocessing starts

if is_worker and "SABOTAGE" in os.environ:
    import service.server.jobs.steps as steps
    from service.server.jobs.steps import frame_numbers

    relight = steps._relight
    steps._relight = {"kill": kill, "hang": hang, "slow": slow, "long": slow_if_long}[os.environ["SABOTAGE"]]

if is_worker and "PIECES" in os.environ:
    import random
    from pathlib import Path

    import service.solve.base.batches as batches
    import stage.stack.stack as stack
    from service.server.jobs.pieces import JobPieces

    claim, together = JobPieces.claim, Path(os.environ["TOGETHER"])

    def claim_together(self, name):
        taken = claim(self, name)
        if taken:
            begun = together / self._job.id
            begun.mkdir(parents=True, exist_ok=True)
            (begun / self._context.worker).touch()
            while len(list(begun.iterdir())) < 2:
                time.sleep(0.05)
        return taken

    JobPieces.claim = claim_together

    stack.BAND_BYTES, batches.BATCH_BYTES = 1 << 14, 1 << 15
    upload = batches.packs.upload

    def slow_upload(*arguments, **options):
        time.sleep(float(os.environ["PIECES"]) * random.uniform(0.5, 1.5))  # so that workers do not claim in step
        return upload(*arguments, **options)

    batches.packs.upload = slow_upload
