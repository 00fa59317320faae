"""The log lines about a board that stops sending and starts again, about the heartbeat's priority,
and about a lost port."""
import logging
import os
import time

import pytest

from fake_boards import until
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.arduino.calibration import Calibration
from serial_communication.link import link as link_module
from serial_communication.link.link import SILENCE
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link.presence import PresenceLog
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.mcu import wire as mcu
from serial_communication.transport.port import Port


@pytest.fixture
def said(lines):
    """Returns the lines so far that have "the board" in them, without the link's name."""
    def find():
        return [line.split(': ', 1)[1] for line in lines('', logging.INFO)
                if 'the board' in line]
    return find


@pytest.fixture
def presence(logger):
    return PresenceLog(SparingLog('mcu', logger))


def test_each_change_is_logged_once(presence, said):
    for at, talks in enumerate((None, True, True, False, False, None, True)):
        presence.update(talks, 'the board is silent', float(at))
    assert said() == ['ready: the board talks', 'the board is silent',
                      'the board is back, it was silent for 3 s']


def test_a_car_that_calibrates_does_not_count_as_silent(line, logger):
    link = ArduinoLink(Port(line.path), logger=logger)
    now = time.monotonic()
    link.last_frame_at = link.connection.opened_at = now
    later = now + 2 * SILENCE
    assert link.talks(later) is False
    link.output.calibration = Calibration(900.0, later)
    assert link.talks(later) is None


def test_silence_from_the_beginning_is_logged_after_the_startup_time(
        line, open_link, said, monkeypatch):
    monkeypatch.setattr(link_module, 'STARTUP_TIME', 0.5)
    began = time.monotonic()
    open_link(McuLink, timeout=0.1)
    until(said)
    assert time.monotonic() >= began + 0.5
    assert said()[0].startswith('the board is silent')
    talk = mcu.encode(mcu.SensorStatus(1, 2, 0.0, 0.0, 0.0), 0)
    until(lambda: line.write(talk) or len(said()) >= 2)
    assert said()[1] == 'ready: the board talks'


@pytest.mark.parametrize('granted', [True, False])
def test_whether_the_heartbeat_has_real_time_priority_is_logged_once(
        open_link, lines, monkeypatch, granted):
    def schedule(*_arguments):
        if not granted:
            raise PermissionError
    monkeypatch.setattr(os, 'sched_setscheduler', schedule)
    open_link(ArduinoLink)
    until(lambda: lines('real-time', logging.INFO))
    said, = lines('real-time', logging.INFO)
    assert said.startswith('arduino: the heartbeat has real-time priority' if granted else
                           'arduino: no real-time priority for the heartbeat')
    assert ('rtprio' in said) == (not granted)
