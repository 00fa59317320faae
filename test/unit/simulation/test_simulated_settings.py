"""Simulated boards keep settings, limit them, report all in turn and forget them at a reset."""
from importlib import import_module

import pytest

from serial_communication.boards import description
from serial_communication.framing.announcement import Assembly, Chunk, read_announcement
from serial_communication.framing.rows import SettingMessage, message_of
from serial_communication.simulation.custom_messages import Configured, announced_text
from serial_communication.simulation.line import SimulatedLine

ROWS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.5, 'maximum': 10},
        'ramp': {'setting': 7, 'layout': '<H', 'unit': 'ms'}}


class Bench:
    """A simulated board on a line, and the messages that it has sent."""

    def __init__(self, name, announces=False, rows=ROWS):
        self.description = description(name)
        config = Configured(self.description, {'settings': rows})
        text = announced_text(name, config) if announces else None
        make = import_module(f'serial_communication.boards.{name}.simulator').BOARD
        self.board = make(settings=config.settings, announcement=text)
        self.decoder = self.description.decoder(False, {'settings': rows})
        self.kind = message_of(config.settings)
        self.sent = []
        self.line = SimulatedLine(self.board, self._write)
        self.now = 100.0
        self.line.start(self.now)

    def _write(self, data):
        self.sent += [frame.message for frame in self.decoder.feed(data)]

    def step(self, seconds):
        end = self.now + seconds
        while self.now < end:
            self.now = round(self.now + 0.01, 3)
            self.line.tick(self.now)

    def set(self, number, value):
        wire = import_module(f'serial_communication.boards.{self.description.name}.wire')
        extra = (3,) if self.description.name == 'mcu' else ()
        before = b'\0' * (not extra)
        self.line.receive(before + wire.encode(self.kind(number, value), *extra), self.now)
        self.step(0.05)

    def settings(self):
        found = [tuple(message) for message in self.sent if isinstance(message, SettingMessage)]
        self.sent.clear()
        return found


@pytest.fixture(params=['arduino', 'mcu'])
def name(request):
    return request.param


def test_all_settings_are_reported_in_turn_with_the_announcement(name):
    bench = Bench(name, announces=True)
    bench.step(0.45)
    chunks = [message for message in bench.sent if isinstance(message, Chunk)]
    assert len(chunks) >= 3
    assert bench.settings()[:4] == [(1, 0.5), (7, 0)] * 2
    bench.step(10)
    bench.settings()
    bench.step(10)
    assert 9 <= len(bench.settings()) <= 11


def test_the_announcement_has_the_rows_of_the_settings(name):
    bench, assembly = Bench(name, announces=True), Assembly()
    bench.step(5)
    texts = [assembly.add(message) for message in bench.sent if isinstance(message, Chunk)]
    text, = [text for text in texts if text]
    assert read_announcement(text).rows == ROWS


def test_a_setting_is_answered_with_the_value_in_use_and_limited(name):
    bench = Bench(name)
    bench.step(5)
    bench.settings()
    for value, used in ((2.5, 2.5), (99.0, 10.0), (0.0, 0.5)):
        bench.set(1, value)
        assert (1, used) in bench.settings()
    bench.set(9, (1, 2))
    assert 9 not in [number for number, _ in bench.settings()]


def test_a_reset_forgets_the_values_and_reports_soon(name):
    bench = Bench(name)
    bench.step(5)
    bench.set(1, 2.5)
    bench.board.power_off(bench.now)
    bench.board.power_on(bench.now)
    bench.settings()
    bench.step(0.25)
    assert set(bench.settings()) == {(1, 0.5), (7, 0)}


def test_a_board_without_settings_sends_none(name):
    bench = Bench(name, rows={})
    bench.step(5)
    bench.set(1, (1, 2, 3, 4))
    assert bench.settings() == []
