"""A new packet, a new function of the bus, and a fourth board, each in a copy of the package.

doc/developing.md lists the places of each. Whichever place is forgotten, the checks name it.
"""
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from sources import ROOT

import facts
from serial_communication import boards
from serial_communication.boards import BoardError, descriptions
from serial_communication.boards.arduino import custom_messages, wire
from serial_communication.boards.description import Description, Topic
from serial_communication.framing.layout import by_type, message_class

ARDUINO, MCU = (f'serial_communication/boards/{name}/' for name in ('arduino', 'mcu'))
LAUNCH = 'launch/bridge.launch'

# What a change does in each place: a file, and lines with what is put before them; or a new file.
PACKET = {
    ARDUINO + 'wire.py': ('FROM_BOARD = (SteeringAngle,', "Distance = message_class(\n"
                          "    'Distance', 13, '<H', [Value('value', 'mm')], 'distance', '')\n"
                          'FROM_BOARD = (Distance, SteeringAngle,'),
    ARDUINO + '__init__.py': ("        Topic('~voltage',", "        Topic('~distance', "
                              "'serial_communication/Distance', message=wire.Distance),\n"
                              "        Topic('~voltage',"),
    ARDUINO + 'simulator.py': ('        self._send(wire.Ticks(', '        self._send(wire.Distance('
                               '100))\n        self._send(wire.Ticks('),
    'firmware/protocol/src/arduino_packets.h': ('  Announcement = 255,', '  Distance = 13,\n'
                                                '  Announcement = 255,'),
    'firmware/protocol/src/arduino_packets.h ': ('kMessageTypes = 13', 'kMessageTypes = 14'),
    'doc/protocols.md': ('| 13–254 |',
                         '| 13 | DISTANCE | from the board | uint16, mm |\n| 14–254 |'),
    'msg/Distance.msg': ('', 'Header header\nuint16 value\n')}
FORGOTTEN_PACKET = {
    ARDUINO + 'wire.py': "module 'serial_communication.boards.arduino.wire' has no attribute "
                         "'Distance'",
    ARDUINO + '__init__.py': 'boards/arduino/__init__.py: no Topic has the message Distance',
    ARDUINO + 'simulator.py': 'boards/arduino/simulator.py: Distance is not simulated',
    'firmware/protocol/src/arduino_packets.h':
        'firmware/protocol/src/arduino_packets.h: the type 13 is missing',
    'firmware/protocol/src/arduino_packets.h ':
        'firmware/protocol/src/arduino_packets.h: kMessageTypes is 13, but not the first free type',
    'doc/protocols.md': 'doc/protocols.md: the type 13 of the arduino is missing',
    'msg/Distance.msg': 'msg/Distance.msg: there is no such file'}
BUS = 'serial_communication/boards/bus/'
FUNCTION = {
    BUS + 'messages.py': ('BUILT_IN = by_number((', "HORN = Function(\n    'horn', 0x23, "
                          "request=Layout('<B', [Value('seconds')]), service='~horn',\n"
                          "    srv_type='serial_communication/Horn')\n"
                          'BUILT_IN = by_number((HORN, '),
    BUS + 'simulator.py': ('        if request.cmd2 not in (wire.LIFT,', '        if request.cmd2 '
                           '== 0x23:\n            return wire.Reply(wire.OK)\n'
                           '        if request.cmd2 not in (wire.LIFT,'),
    'srv/Horn.srv': ('', 'uint8 seconds\n---\nbool success\nstring message\n'),
    'firmware/protocol/src/robot_ctrl_bus.h': ('const uint8_t kFunctionStop', 'const uint8_t '
                                               'kFunctionHorn = 0x23;\nconst uint8_t '
                                               'kFunctionStop'),
    'doc/protocols.md': ('| 0x22 | environment', '| 0x23 | horn | seconds | – |\n'
                         '| 0x22 | environment')}
FORGOTTEN_FUNCTION = {
    BUS + 'messages.py': 'boards/bus/messages.py: the function 0x23 of the firmware is missing',
    BUS + 'simulator.py': 'boards/bus/simulator.py: horn is not simulated',
    'srv/Horn.srv': 'srv/Horn.srv: there is no such file',
    'firmware/protocol/src/robot_ctrl_bus.h':
        'firmware/protocol/src/robot_ctrl_bus.h: the function 0x23 is missing',
    'doc/protocols.md': 'doc/protocols.md: the function 0x23 is missing'}
BOARD = {
    'serial_communication/boards/__init__.py': ("'arduino', 'mcu')", "'arduino', 'mcu', 'sonar')"),
    **{f'serial_communication/boards/sonar/{name}': (ROOT / MCU / name, ("'mcu'", "'sonar'"),
                                                     ("'mcu/", "'sonar/"))
       for name in ('__init__.py', *facts.FILES)},
    'config/bridge.yaml': ('mcu:   ', 'sonar: {port: /dev/ttyUSB2, baud: 115200}\nmcu:   '),
    LAUNCH + ' ': ('  <arg name="publish_tf"',
                   '  <arg name="sonar_port" default="as configured"/>\n  <arg name="publish_tf"'),
    LAUNCH: ('value="bus arduino mcu"', 'value="bus arduino mcu sonar"')}
FORGOTTEN_BOARD = {
    'serial_communication/boards/__init__.py': 'boards/__init__.py: BOARDS has no sonar',
    **{f'serial_communication/boards/sonar/{name}': f'boards/sonar/{name}: there is no such file'
       for name in facts.FILES if name != 'wire.py'},
    'serial_communication/boards/sonar/wire.py': "importing 'serial_communication.boards.sonar' f",
    'serial_communication/boards/sonar/__init__.py':
        "the module 'sonar' has no DESCRIPTION of a board",
    'config/bridge.yaml': 'config/bridge.yaml: sonar has not the rate of its description',
    LAUNCH + ' ': 'launch/bridge.launch: there is no argument sonar_port',
    LAUNCH: 'launch/bridge.launch: the argument boards has no sonar'}
CHANGES = [(PACKET, FORGOTTEN_PACKET), (FUNCTION, FORGOTTEN_FUNCTION), (BOARD, FORGOTTEN_BOARD)]


def test_every_place_knows_of_every_board_packet_function_and_thread():
    assert facts.problems(ROOT) == []


@pytest.fixture(name='copy')
def fixture_copy(tmp_path):
    """A copy of what the checks read."""
    for folder in ('serial_communication', 'config', 'launch', 'msg', 'srv', 'doc', 'firmware'):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns(
            '__pycache__', 'web', 'emulator', '*.png', 'esp32'))
    return tmp_path


def change(copy, place, edit):
    """Make the change of one place; the end of its key tells two changes of a file apart."""
    path = copy / place.rstrip()
    if isinstance(edit[0], Path):
        text = edit[0].read_text()
        for old, new in edit[1:]:
            text = text.replace(old, new)
    elif path.exists():
        assert edit[0] in path.read_text(), place
        text = path.read_text().replace(*edit, 1)
    else:
        text = edit[1]
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def checked(copy, program=(facts.__file__,)):
    """What the checks say of a copy."""
    return subprocess.run([sys.executable, *program, str(copy)], stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, cwd=str(copy), timeout=60,
                          env={**os.environ, 'PYTHONPATH': str(copy)}).stdout


@pytest.mark.parametrize('places, said, left_out', [
    (places, said, left_out) for places, said in CHANGES for left_out in ('', *said)],
    ids=lambda value: value or 'none' if isinstance(value, str) else '')
def test_a_forgotten_place_is_named(copy, places, said, left_out):
    for place, edit in places.items():
        if place != left_out:
            change(copy, place, edit)
    words = said.get(left_out, '\n')
    assert words in checked(copy) if left_out else checked(copy) == words


def test_a_thread_that_the_page_does_not_list_is_named(copy):
    change(copy, 'serial_communication/ros/traffic.py', ("name='serial_msg'", "name='traffic'"))
    assert checked(copy) == 'doc/developing.md: the thread "traffic" of traffic.py is missing\n'


def test_no_row_takes_the_type_or_the_name_of_a_new_packet(copy):
    for place, edit in PACKET.items():
        change(copy, place, edit)
    row = "{'%s': {'type': %d, 'ros_type': 'a/B', 'layout': '<B', 'fields': ['data']}}"
    script = 'from serial_communication.boards.arduino import custom_messages as read\nread(%s)'
    assert checked(copy, ('-c', script % (row % ('force', 14)))) == ''
    assert 'force/type is 13 (int), may be a whole number from 14 to 254' in checked(
        copy, ('-c', script % (row % ('force', 13))))
    assert '~distance' in checked(copy, ('-c', 'from serial_communication.boards import '
                                         'descriptions\nprint(descriptions()[1].names)'))


# -- what is taken twice ----------------------------------------------------------------------


def test_two_classes_of_one_type_are_refused():
    twin = message_class('Twin', 8, '<', ())
    with pytest.raises(ValueError, match='^Ticks and Twin have the same type, 8$'):
        by_type(wire.Ticks, twin)
    with pytest.raises(ValueError, match='^Log and Twin have the same type, 2$'):
        by_type(wire.Log, message_class('Twin', 2, '<', ()))


@pytest.mark.parametrize('type_', sorted(wire.BUILT_IN))
def test_a_row_with_a_built_in_type_is_refused(type_):
    with pytest.raises(ValueError, match=f'force/type is {type_} '):
        custom_messages({'force': {'type': type_, 'ros_type': 'a/B', 'layout': '<B',
                                   'fields': ['data']}})


def test_two_topics_of_one_name_are_refused(monkeypatch):
    topics = [Topic('~imu', 'std_msgs/Bool'), Topic('~imu', 'std_msgs/Bool')]
    with pytest.raises(ValueError, match='two topics or services ~imu'):
        Description('one', 'one', None, topics=topics)
    twin = Description('twin', 'twin', None, topics=topics[:1], other_names=('~led',))
    known = boards.description
    monkeypatch.setattr(boards, 'BOARDS', (*boards.BOARDS, 'twin'))
    monkeypatch.setattr(boards, 'description', lambda name: twin if name == 'twin' else known(name))
    with pytest.raises(BoardError, match='^two boards name a topic or service ~imu and ~led$'):
        descriptions()
