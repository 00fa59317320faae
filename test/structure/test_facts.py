"""A new packet, a new function of the bus, and a fourth board, each in a copy of the package.

doc/developing.md lists the places of each. Whichever place is forgotten, the checks name it.
"""
import os
import shutil
import subprocess
import sys

import pytest
from sources import ROOT

import facts
from serial_communication import boards
from serial_communication.boards import BoardError, descriptions
from serial_communication.boards.arduino import custom_messages, wire
from serial_communication.boards.description import Description, Topic
from serial_communication.framing.layout import by_type, message_class

BOARDS = 'serial_communication/boards/'
ARDUINO, BUS = BOARDS + 'arduino/', BOARDS + 'bus/'
LAUNCH = 'launch/bridge.launch'

# What a change does in each place: a file, what is put instead of what (a new file: instead of ''),
# and what the checks say if this place is forgotten.
HEADERS = 'firmware/protocol/src/'
PAGE = 'doc/protocols.md'
PACKET = [
    (ARDUINO + 'wire.py', 'FROM_BOARD = (', "Distance = message_class(\n"
     "    'Distance', 13, '<H', [Value('value', 'mm')], 'distance', '')\nFROM_BOARD = (Distance, ",
     "module 'serial_communication.boards.arduino.wire' has no attribute 'Distance'"),
    (ARDUINO + '__init__.py', "        Topic('~voltage',", "        Topic('~distance', "
     "'serial_communication/Distance', message=wire.Distance),\n        Topic('~voltage',",
     'boards/arduino/__init__.py: no Topic has the message Distance'),
    (ARDUINO + 'simulator.py', '        self._send_measured(*measured)',
     '        self._send_measured(*measured, wire.Distance(100))',
     'boards/arduino/simulator.py: Distance is not simulated'),
    (HEADERS + 'arduino_packets.h', '  Announcement =', '  Distance = 13,\n  Announcement =',
     f'{HEADERS}arduino_packets.h: the type 13 is missing'),
    (HEADERS + 'arduino_packets.h', 'kMessageTypes = 13', 'kMessageTypes = 14',
     f'{HEADERS}arduino_packets.h: kMessageTypes is 13, but not the first free type'),
    (PAGE, '| 13–252 |', '| 13 | DISTANCE | from the board | uint16, mm |\n| 14–252 |',
     f'{PAGE}: the type 13 of the arduino is missing'),
    ('msg/Distance.msg', '', 'Header header\nuint16 value\n',
     'msg/Distance.msg: there is no such file')]
FUNCTION = [
    (BUS + 'messages.py', 'BUILT_IN = by_number((', "HORN = Function(\n    'horn', 0x23, "
     "request=Layout('<B', [Value('seconds')]), service='~horn',\n"
     "    srv_type='serial_communication/Horn')\nBUILT_IN = by_number((HORN, ",
     'boards/bus/messages.py: the function 0x23 of the firmware is missing'),
    (BUS + 'simulator.py', '        if request.cmd2 not in (wire.LIFT,',
     '        if request.cmd2 == 0x23:\n            return wire.Reply(wire.OK)\n'
     '        if request.cmd2 not in (wire.LIFT,',
     'boards/bus/simulator.py: horn is not simulated'),
    ('srv/Horn.srv', '', 'uint8 seconds\n---\nbool success\nstring message\n',
     'srv/Horn.srv: there is no such file'),
    (HEADERS + 'robot_ctrl_bus.h', 'const uint8_t kFunctionStop',
     'const uint8_t kFunctionHorn = 0x23;\nconst uint8_t kFunctionStop',
     f'{HEADERS}robot_ctrl_bus.h: the function 0x23 is missing'),
    (PAGE, '| 0x22 | environment', '| 0x23 | horn | seconds | – |\n| 0x22 | environment',
     f'{PAGE}: the function 0x23 is missing')]
SONAR = {'__init__.py': "the module 'sonar' has no DESCRIPTION of a board",
         'wire.py': "cannot import name 'wire'",
         **{name: f'boards/sonar/{name}: there is no such file' for name in facts.FILES[1:]}}
BOARD = [
    (BOARDS + '__init__.py', "'arduino', 'mcu')", "'arduino', 'mcu', 'sonar')",
     'boards/__init__.py: BOARDS has no sonar'),
    ('config/bridge.yaml', 'mcu:   ', 'sonar: {port: /dev/ttyUSB2, baud: 115200}\nmcu:   ',
     'config/bridge.yaml: sonar has not the rate of its description'),
    (LAUNCH, '  <arg name="publish_tf"', '  <arg name="sonar_port" default="as configured"/>\n'
     '  <arg name="publish_tf"', f'{LAUNCH}: there is no argument sonar_port'),
    (LAUNCH, 'value="bus arduino mcu"', 'value="bus arduino mcu sonar"',
     f'{LAUNCH}: the argument boards has no sonar'),
    *((f'{BOARDS}sonar/{name}', '', (ROOT / BOARDS / 'mcu' / name).read_text().replace(
        "'mcu'", "'sonar'").replace("'mcu/", "'sonar/"), said) for name, said in SONAR.items())]
# Each change, and the places that are left out of it, by number: none, those alone that others
# need, and all others together.
CHANGES = [(places, left_out)
           for places, alone in ((PACKET, '06'), (FUNCTION, '0'), (BOARD, '045'))
           for left_out in ('', *alone, ''.join(str(number) for number in range(len(places))
                                                if str(number) not in alone))]


def test_every_place_knows_of_every_board_packet_function_and_thread():
    assert facts.problems(ROOT) == []


@pytest.fixture(name='copy')
def fixture_copy(tmp_path):
    """A copy of what the checks read."""
    for folder in ('serial_communication', 'config', 'launch', 'msg', 'srv', 'doc', 'firmware'):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns(
            '__pycache__', 'web', 'emulator', '*.png', 'esp32'))
    return tmp_path


def change(copy, place, old, new):
    """Make the change of one place."""
    path = copy / place
    text = path.read_text() if path.exists() else ''
    assert old in text, place
    path.parent.mkdir(exist_ok=True)
    path.write_text(text.replace(old, new, 1))


def checked(copy, program=(facts.__file__,)):
    """What the checks say of a copy."""
    return subprocess.run([sys.executable, *program, str(copy)], stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, cwd=str(copy), timeout=60,
                          env={**os.environ, 'PYTHONPATH': str(copy)}).stdout


@pytest.mark.parametrize('places, left_out', CHANGES,
                         ids=lambda value: value if isinstance(value, str) else value[0][0])
def test_a_forgotten_place_is_named(copy, places, left_out):
    for number, (place, old, new, _said) in enumerate(places):
        if str(number) not in left_out:
            change(copy, place, old, new)
    said = checked(copy)
    assert [places[int(number)][3] in said for number in left_out] == [True] * len(left_out), said
    assert left_out or said == '\n', said


def test_a_thread_that_the_page_does_not_list_is_named(copy):
    change(copy, 'serial_communication/ros/traffic.py', "name='serial_msg'", "name='traffic'")
    assert checked(copy) == 'doc/developing.md: the thread "traffic" of traffic.py is missing\n'


def test_no_row_takes_the_type_or_the_name_of_a_new_packet(copy):
    for place, old, new, _said in PACKET:
        change(copy, place, old, new)
    row = "{'%s': {'type': %d, 'ros_type': 'a/B', 'layout': '<B', 'fields': ['data']}}"
    script = 'from serial_communication.boards.arduino import custom_messages as read\nread(%s)'
    assert checked(copy, ('-c', script % (row % ('force', 14)))) == ''
    assert 'force/type is 13 (int), may be a whole number from 14 to 252' in checked(
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
