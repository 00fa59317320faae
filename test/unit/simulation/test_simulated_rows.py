"""Rows that simulated boards play, answer, announce and set."""
import argparse
import os
import struct

import pytest
from board_rows import car_messages, functions
from lines import ROOT
from simulation_bench import Bench

from serial_communication.boards import BOARDS, description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.simulation.arguments import board_parameters, read_parameters
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.framing.announcement import Assembly, Chunk, read_announcement
from serial_communication.framing.rows import Kind
from serial_communication.simulation.announcing import chunks_of
from serial_communication.simulation.custom_messages import (Configured, add_options,
                                                             announced_text, simulated_values)

EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
FUNCTIONS, CAR, SENSORS = (
    board.read_all(board_parameters(read_parameters(EXAMPLES), board.name))
    for board in map(description, BOARDS))
WIRES = {ModelCar: arduino, SensorBoard: mcu}
both = pytest.mark.parametrize('board', WIRES, ids=lambda board: board.NAME)


# -- messages and functions -----------------------------------------------------------------------


@pytest.mark.parametrize('board, rows', [(ModelCar, CAR), (SensorBoard, SENSORS)])
def test_every_message_of_the_examples_is_played_within_its_limits(board, rows):
    kinds = [row.message for row in rows if row.kind is Kind.FROM]
    bench = Bench(board(custom=rows), WIRES[board].Decoder(messages=kinds))
    bench.run(20.0001)
    frames = bench.decoder.feed(bench.output())
    assert not any(frame.cause for frame in frames)
    for kind in kinds:
        played = [frame.message.pack() for frame in frames if type(frame.message) is kind]
        assert len(played) == 200 and len(set(played)) > 1


@pytest.mark.parametrize('values, low, high', [
    ({'layout': '<b'}, -100, 100), ({'layout': '<B'}, 0, 100),
    ({'layout': '<f', 'minimum': 1e6}, 1e6, 1e6 + 200),
    ({'layout': '<h', 'maximum': -5000}, -5200, -5000),
    ({'layout': '<B', 'scale': -2, 'minimum': -7, 'maximum': -3}, -6, -4),
    ({'layout': '<?'}, 0, 1), ({'layout': '<d', 'minimum': 3, 'maximum': 3}, 3, 3)])
def test_simulated_values_cover_their_range_and_stay_in_it(values, low, high):
    row, = car_messages({'any': dict(values, type=99, ros_type='a/B', fields=['data'])})
    numbers = [row.layout.unpack(row.layout.pack(simulated_values(row.layout, tick / 7)))[0]
               for tick in range(500)]
    assert low <= min(numbers) and max(numbers) <= high
    assert max(numbers) - min(numbers) >= 0.9 * (high - low)


@both
def test_a_row_with_a_time_has_that_of_the_boards_clock(board):
    row, = description(board.NAME).read('messages', {'force': {
        'type': 40, 'ros_type': 'a/B', 'layout': '<hI', 'fields': ['x', '@time']}})
    bench = Bench(board(custom=[row]), WIRES[board].Decoder(messages=[row.message]))
    bench.run(1.05)
    times = [message[1] for message in bench.messages(row.message)]
    assert times == pytest.approx([100_000 * number for number in range(1, 11)], abs=1)


def asked(bench, *requests):
    """Send requests to the bus board; return the replies."""
    bench.feed(b''.join(map(bus.encode_request, (bus.SYNC_REQUEST, *requests))))
    bench.run(0.01)
    return [frame.message for frame in bench.decoder.feed(bench.output())][1:]


def test_custom_functions_are_answered_within_their_limits():
    bench = Bench(ControlBoard(custom=FUNCTIONS + functions({'speed': {
        'cmd2': 0x60, 'srv_type': 'a/B',
        'request': {'layout': '<B', 'fields': ['speed'], 'maximum': 10}}})), bus.ReplyDecoder())
    by_name = {function.name: function for function in FUNCTIONS}
    pumped, level, tank, malformed, unsupported, slow, fast = asked(
        bench, by_name['pump'].make_request((True,)), by_name['read_level'].make_request(()),
        by_name['tank'].make_request(()), bus.Request(bus.FUNCTION, 0x30),
        bus.Request(bus.FUNCTION, 0x33), bus.Request(bus.FUNCTION, 0x60, b'\x0a'),
        bus.Request(bus.FUNCTION, 0x60, b'\x0b'))
    assert pumped == bus.Reply(bus.OK) and 'pump data=true' in bench.said
    assert by_name['read_level'].reply.unpack(level.data)[0].startswith('simulated')
    assert 0 <= by_name['tank'].reply.unpack(tank.data)[0] <= 655350
    assert [malformed.error_code, unsupported.error_code] == [bus.MALFORMED, bus.UNSUPPORTED]
    assert [slow.cmd1, fast.cmd1] == [bus.OK, bus.ERROR]


# -- announcements --------------------------------------------------------------------------------


TEXT = b'firmware: simulated_arduino 1.0\nforce: {type: 32}\n' * 5


@pytest.mark.parametrize('name', BOARDS)
def test_the_examples_are_announced_as_they_stand_in_the_file(name):
    parser = argparse.ArgumentParser()
    add_options(parser, description(name))
    options = parser.parse_args(['--config', EXAMPLES, '--announce'])
    given = board_parameters(read_parameters(EXAMPLES), name)
    assert read_announcement(announced_text(name, options.config)) == (
        f'simulated_{name} 1.0', given[description(name).groups[0].parameter], [])


@both
@pytest.mark.parametrize('times', [1, 8], ids=['3 s', 'until each was sent twice'])
def test_chunks_are_sent_ten_times_a_second_at_first_and_then_once(board, times):
    bench = Bench(board(announcement=TEXT * times), WIRES[board].Decoder())
    size = len(chunks_of(TEXT * times, 60))
    count = max(30, 2 * size)
    bench.run(0.1 * count - 0.05)
    chunks = bench.messages(Chunk)
    assert len(chunks) in (count - 1, count)
    assert [chunk.index for chunk in chunks] == [n % size for n in range(len(chunks))]
    assert list(filter(None, map(Assembly().add, chunks))) == [TEXT * times]
    bench.run(1.0)
    bench.output()
    bench.run(5.0)
    assert len(bench.messages(Chunk)) in (5, 6)


def test_the_control_board_answers_with_the_chunk_that_it_is_asked_for():
    chunks = chunks_of(TEXT, 60)
    indices = [*reversed(range(len(chunks)))]

    def replies(board, *data):
        return asked(Bench(board, bus.ReplyDecoder()),
                     *(bus.Request(bus.FUNCTION, 0xFF, each) for each in data))
    board = ControlBoard(announcement=TEXT)
    assert [reply.data for reply in replies(board, *(bytes((each,)) for each in indices))] == [
        chunks[each].pack() for each in indices]
    assert {reply.error_code for reply in replies(board, bytes((len(chunks),)), b'', b'\0\0')} \
        == {bus.MALFORMED}
    assert [reply.error_code for reply in replies(ControlBoard(), b'\0')] == [bus.UNSUPPORTED]


# -- settings -------------------------------------------------------------------------------------


SETTING = 253     # their type on the wire
ROWS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.5, 'maximum': 10},
        'ramp': {'setting': 7, 'layout': '<H', 'unit': 'ms'}}


def tuned(board, rows=ROWS, announces=False):
    """A bench with a board that has these settings."""
    described = description(board.NAME)
    config = Configured(described, {'settings': rows})
    text = announced_text(board.NAME, config) if announces else None
    return Bench(board(settings=config.settings, announcement=text),
                 described.decoder(False, {'settings': rows}))


def reported(bench):
    """The settings that the board has sent since the last call."""
    return [tuple(message) for message in bench.messages() if message.TYPE == SETTING]


def set_to(bench, number, value):
    """Set a setting; return the settings that the board sends within 50 ms."""
    data = bytes((number,)) + struct.pack('<f', value)
    bench.output()
    bench.feed(b'\0' + arduino.encode_raw(SETTING, data) if isinstance(bench.board, ModelCar)
               else mcu.encode_raw(SETTING, 3, data))
    bench.run(0.05)
    return reported(bench)


@both
def test_all_settings_are_reported_in_turn_with_the_announcement(board):
    bench, assembly = tuned(board, announces=True), Assembly()
    bench.run(0.45)
    found = bench.messages()
    assert [tuple(each) for each in found if each.TYPE == SETTING][:4] == [(1, 0.5), (7, 0)] * 2
    bench.run(5)
    found += bench.messages()
    texts = [assembly.add(message) for message in found if isinstance(message, Chunk)]
    assert [read_announcement(text).rows for text in texts if text] == [ROWS]
    bench.run(10)
    assert 9 <= len(reported(bench)) <= 11


@both
def test_a_setting_is_answered_with_the_value_in_use_until_a_reset(board):
    bench = tuned(board)
    bench.run(5)
    for value, used in ((99.0, 10.0), (0.0, 0.5), (2.5, 2.5)):
        assert (1, used) in set_to(bench, 1, value)
    assert 9 not in [number for number, _ in set_to(bench, 9, 1.0)]
    bench.board.power_off(bench.now)
    bench.board.power_on(bench.now)
    bench.output()
    bench.run(0.25)
    assert set(reported(bench)) == {(1, 0.5), (7, 0)}
