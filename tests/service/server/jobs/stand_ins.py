"""What a supervisor is given in place of a worker; in a module of its own, which the process that is spawned imports."""

import os
import time


def never_ready(settings, device, heartbeat):
    os._exit(1)


def ready_and_dead(settings, device, heartbeat):
    heartbeat.ready()
    os._exit(1)


def stuck_at_the_start(settings, device, heartbeat):
    time.sleep(3600)


def without_a_beat(settings, device, heartbeat):
    heartbeat.ready()
    time.sleep(3600)


def stuck_in_a_step(settings, device, heartbeat):
    heartbeat.ready()
    heartbeat.step(time.monotonic())
    while True:
        heartbeat.beat()
        time.sleep(0.05)
