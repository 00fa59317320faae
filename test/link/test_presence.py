"""The log lines about a board that stops sending and starts again, about the heartbeat's priority,
and about a lost port."""
import logging
import os
import time

import pytest

from fake_boards import CarBoard, until
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.arduino.calibration import Calibration
from serial_communication.link import link as link_module
from serial_communication.link.link import SILENCE
from serial_communication.boards.mcu.link import McuLink
from serial_communication.link.presence import LOOK_PERIOD, PresenceLog
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.transport import pace
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


def test_frequent_changes_are_logged_sparingly_and_the_last_state_is_logged(presence, said):
    changes = 1000
    for at in range(changes):
        presence.update(at % 2 == 0, 'the board is silent', at * LOOK_PERIOD)
    # In 10 s one line that it is silent, and one that it is back.
    assert 10 < len(said()) <= 5 + 2 * changes * LOOK_PERIOD / 10
    end = changes * LOOK_PERIOD
    for late in range(0, 40):
        presence.update(False, 'the board is silent', end + late * LOOK_PERIOD)
    assert said()[-1] == 'the board is silent'


def test_a_stall_just_before_a_line_does_not_bring_the_next_one_closer(
        line, logger, said, monkeypatch):
    link = McuLink(Port(line.path), logger=logger)

    def check(talks, now, stall=0.0):
        monkeypatch.setattr(link, 'talks', lambda _now: talks)
        monkeypatch.setattr(pace, 'clock', lambda: now + stall)
        link.check(now)
    for now, talks, stall in ((9.0, True, 0.0), (10.0, False, 0.0), (12.0, True, 1.3),
                              (20.5, False, 0.0), (22.5, True, 0.0)):
        check(talks, now, stall)
    assert len(said()) == 4 and said()[-1].startswith('the board is silent')
    check(True, 23.5)
    assert len(said()) == 5 and said()[-1].startswith('the board is back')


def test_a_car_that_talks_falls_silent_and_is_back_is_logged(line, running, open_link, said):
    class Car(CarBoard):
        talks = True

        def idle(self):
            if self.talks:
                self.line.write(arduino.encode(arduino.Voltage(12.0)))

    car = running(Car(line))
    link = open_link(ArduinoLink, ArduinoSettings(network_silence=0.0))
    until(lambda: said() == ['ready: the board talks'])
    assert 'silent' not in link.condition(link.last_frame_at)[1]
    car.talks = False
    until(lambda: len(said()) == 2)
    assert 'open, the board is silent' in link.condition(time.monotonic())[1]
    assert said()[1] == ('the board is silent; check its power, its wiring and the baud rate '
                         '(115200)')
    car.talks = True
    until(lambda: len(said()) == 3)
    assert said()[2].startswith('the board is back, it was silent for ')


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


def test_a_port_lost_while_the_bridge_ends_is_not_logged(line, open_link, lines):
    link = open_link(McuLink)
    line.unplug()
    until(lambda: not link.port.is_open)
    link.stop()
    link.join()
    assert not lines()


def test_a_port_lost_at_another_time_is_logged_in_order_and_sparingly(line, open_link, lines):
    link = open_link(McuLink)
    line.unplug()
    until(lambda: len(lines()) == 2)
    assert 'opening it again when it returns' in lines()[0] and 'waiting for it' in lines()[1]
    line.plug()
    until(lambda: link.connection.reconnects)
    before = len(lines())
    line.unplug()
    line.plug()
    until(lambda: link.connection.reconnects == 2)
    assert len(lines()) == before       # the same loss within 10 s is not logged again


def test_reasons_for_a_silence_that_differ_each_time_are_not_kept(presence):
    for number in range(1000):
        presence.update(False, f'only frames of type {number} are received', float(number))
    assert len(presence._logged_at) <= 11
