"""The thread that writes all black boxes of a process."""

from __future__ import annotations

import threading
from collections.abc import Callable

from zbridge.blackbox.disk_thread import DiskThread

JOIN_S = 10.0
"""Longest time a thread of a test may take; no test waits that long."""


class Job:
    """Counts its rounds, and stops itself after the last one."""

    def __init__(self, disk: DiskThread, rounds: int = 1) -> None:
        self.disk = disk
        self.rounds = 0
        self.done = threading.Event()
        self._most = rounds
        self.threads: set[str] = set()

    def __call__(self) -> None:
        self.rounds += 1
        self.threads.add(threading.current_thread().name)
        if self.rounds == self._most:
            self.disk.remove(self)
            self.done.set()


def gone(name: str = "zbridge-blackbox") -> None:
    for thread in threading.enumerate():
        if thread.name == name:
            thread.join(JOIN_S)
    assert not any(thread.name == name for thread in threading.enumerate())


def test_a_job_is_done_in_each_period_on_a_thread_that_exists_only_while_there_is_one() -> None:
    disk = DiskThread(period_s=0.001)
    job = Job(disk, 3)
    gone()
    disk.add(job)
    assert job.done.wait(JOIN_S)
    gone()
    assert (job.rounds, job.threads) == (3, {"zbridge-blackbox"})


def test_a_round_begins_at_once_where_it_is_woken() -> None:
    disk = DiskThread(period_s=3600.0)
    job = Job(disk)
    disk.add(job)
    assert job.rounds == 0
    disk.wake()
    assert job.done.wait(JOIN_S)
    gone()


def test_one_thread_does_all_jobs_and_a_later_one_has_a_thread_again() -> None:
    disk = DiskThread(period_s=0.001)
    before = threading.active_count()
    for _ in range(2):
        jobs = [Job(disk, rounds) for rounds in (500_000, 2)]
        for job in jobs:
            disk.add(job)
        assert threading.active_count() == before + 1
        assert jobs[1].done.wait(JOIN_S)
        disk.remove(jobs[0])
        disk.remove(jobs[0])
        gone()
        assert jobs[0].rounds >= 2


def test_jobs_that_come_and_go_at_once_are_all_done() -> None:
    disk = DiskThread(period_s=0.0001)
    jobs = [Job(disk) for _ in range(200)]

    def add(some: list[Callable[[], None]]) -> None:
        for job in some:
            disk.add(job)

    threads = [threading.Thread(target=add, args=(jobs[first::4],)) for first in range(4)]
    for thread in threads:
        thread.start()
    for job in jobs:
        assert job.done.wait(JOIN_S)
    assert [job.rounds for job in jobs] == [1] * 200
    gone()
