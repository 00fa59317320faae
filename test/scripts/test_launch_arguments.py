"""Arguments of roslaunch that do not reach bridge.launch."""
import pytest

from serial_communication.ros.launch_arguments import (empty_ports, roslaunch_words,
                                                       unknown_arguments)

COMMAND = ['/usr/bin/python3', '/opt/ros/noetic/bin/roslaunch', 'serial_communication',
           'bridge.launch']


@pytest.mark.parametrize('words, warnings', [
    ([], []), (['sim:=true', 'arduino_port:=/dev/ttyUSB0', 'control:=true', '__name:=a'], []),
    (['arduino_prt:=/dev/ttyUSB0'], [
        'bridge.launch has no argument arduino_prt, so arduino_prt:=/dev/ttyUSB0 has no effect; '
        'did you mean arduino_port?']),
    (['own_ports:=true'], ['bridge.launch has no argument own_ports, so own_ports:=true has no '
                           'effect']),
    (['zzz:='], ['bridge.launch has no argument zzz, so zzz:= has no effect'])])
def test_an_argument_that_the_launch_file_does_not_have_is_named(words, warnings):
    found = unknown_arguments(COMMAND + words)
    assert len(found) == len(warnings)
    assert all(line.startswith(start) for line, start in zip(found, warnings))


def test_a_process_that_roslaunch_did_not_start_has_none():
    assert roslaunch_words() == []


def test_an_argument_without_a_value_names_a_link():
    assert empty_ports([*COMMAND, 'mcu_port:=', 'bus_port:=/dev/ttyS0']) == ['mcu']
