"""Progress: a bar on a terminal, elsewhere plain lines; nothing of work that is quick or not to be shown."""

import threading

import pytest

from neuido.data import progress
from neuido.data.progress import Progress, duration


def test_the_plain_line_says_what_how_much_and_how_long():
    work = Progress("trajectories", 120, done=20)
    assert work.line(work.begun + 3) == "trajectories: 20 of 120, 3 s elapsed"
    work.update(20)
    assert work.line(work.begun + 40) == "trajectories: 40 of 120, 40 s elapsed, about 2 min 40 s left"
    work.say("sand-007")
    work.move_to(120)
    assert work.line(work.begun + 4000) == "trajectories: 120 of 120, sand-007, 1 h 6 min elapsed, about 0 s left"
    open_end = Progress("case", unit="simulations")
    open_end.update()
    assert open_end.line(open_end.begun + 1) == "case: 1 simulations, 1 s elapsed"
    whole = Progress("simulating a ball in one run")
    assert whole.line(whole.begun + 31) == "simulating a ball in one run, 31 s elapsed"


@pytest.mark.parametrize(("seconds", "words"), [(0.0, "0 s"), (59.2, "1 min 0 s"), (61, "1 min 1 s"), (7500, "2 h 5 min")])
def test_duration(seconds, words):
    assert duration(seconds) == words


def test_lines_come_while_one_step_takes_long_and_end_with_the_work(monkeypatch, capsys):
    monkeypatch.setattr(progress, "PLAIN_SECONDS", 0.01)
    printed, before = threading.Event(), threading.active_count()
    line = Progress.line
    monkeypatch.setattr(Progress, "line", lambda self, now: (printed.set(), line(self, now))[1])
    with Progress("films", 3, unit="clips"):
        assert printed.wait(60)
    assert "films: 0 of 3 clips, " in capsys.readouterr().err
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and thread.daemon and thread._target is not None:
            thread.join(60)
    assert threading.active_count() <= before


def test_nothing_is_shown_of_quick_work_or_where_it_is_not_wanted(monkeypatch, capsys):
    with Progress("films", 3) as work:
        work.update(3)
    monkeypatch.setattr(progress, "PLAIN_SECONDS", 0.0)
    with Progress("films", 3, shown=False) as work:
        work.update(3)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_has_a_bar(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Progress("films", 3, unit="clips", done=1) as work:
        work.say("clip-00001")
        work.update(1)
        assert work._bar.n == 2 and work._bar.total == 3 and work._bar.desc.startswith("films")
    err = capsys.readouterr().err
    assert "films:" in err and "1/3" in err
