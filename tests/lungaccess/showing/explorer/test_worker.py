"""The loop of a process that answers, without the process."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator
from multiprocessing import Pipe

import pytest

from lungaccess.showing.explorer.questions import PlaceQuestion
from lungaccess.showing.explorer.worker import Asked, Given, Part, PatientSource, Turn, Worker


def test_an_answer_that_cannot_be_sent_is_a_failure_of_its_question_alone(
    capfd: pytest.CaptureFixture[str],
) -> None:
    here, there = Pipe()

    def answering(asked: Asked, _turn: Turn) -> Iterator[Part]:
        yield Part({"answer": "place", "mm": math.nan if asked.question.id == 1 else 1.0})

    thread = threading.Thread(target=Worker(there, answering, lambda _source: None).run)
    thread.start()
    for number in (1, 2):
        question = PlaceQuestion(id=number, slot=str(number), point=(0.0, 0.0, 0.0))
        here.send(Asked(page="page", name="place", question=question))
    given: list[Given] = [here.recv() for _ in range(3)]
    here.close()
    thread.join()
    answers = [json.loads(each.sent)["answer"] for each in given if each.number == 2]
    assert answers == ["place", "end"]
    (failed,) = (each for each in given if each.number == 1)
    assert failed.last and "made the program fail" in json.loads(failed.sent)["error"]["found"]
    assert "Out of range float values" in capfd.readouterr().err


def test_what_is_being_answered_about_masks_from_before_is_superseded() -> None:
    here, there = Pipe()
    renewed: list[PatientSource] = []

    def answering(asked: Asked, turn: Turn) -> Iterator[Part | None]:
        while asked.question.id == 1:
            turn.check()
            yield None
        yield Part({"answer": "place", "masks": len(renewed)})

    thread = threading.Thread(target=Worker(there, answering, renewed.append).run)
    thread.start()
    source = PatientSource(folder=None, system="ultrathin")
    for number in (1, 2):
        question = PlaceQuestion(id=number, slot=str(number), point=(0.0, 0.0, 0.0))
        here.send(Asked(page="page", name="place", question=question))
        if number == 1:
            here.send(source)
    given: list[Given] = [here.recv() for _ in range(3)]
    here.close()
    thread.join()
    assert renewed == [source]
    assert [json.loads(each.sent)["answer"] for each in given] == ["superseded", "place", "end"]
    assert json.loads(given[1].sent)["masks"] == 1
