"""Simulated boards that announce their custom messages."""
import argparse
import os

import pytest
from lines import ROOT
from simulation_bench import Bench

from serial_communication.boards import BOARDS, description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.boards.config_file import board_parameters, read_parameters
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.framing.announcement import Assembly, Chunk, read_announcement
from serial_communication.simulation.announcing import chunks_of
from serial_communication.simulation.custom_messages import add_options, announced_text

EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
TEXT = b'firmware: simulated_arduino 1.0\nforce: {type: 32}\n' * 5
CHUNKS = len(chunks_of(TEXT, 60))


@pytest.mark.parametrize('name', BOARDS)
def test_the_examples_are_announced_as_they_stand_in_the_file(name):
    parser = argparse.ArgumentParser()
    add_options(parser, description(name))
    options = parser.parse_args(['--config', EXAMPLES, '--announce'])
    announcement = read_announcement(announced_text(name, options.config))
    given = board_parameters(read_parameters(EXAMPLES), name)
    assert announcement == (f'simulated_{name} 1.0',
                            given[description(name).groups[0].parameter], [])


def announced(bench, seconds):
    """The chunks that the board sends in this time."""
    bench.run(seconds)
    return [frame.message for frame in bench.decoder.feed(bench.output())
            if isinstance(frame.message, Chunk)]


@pytest.mark.parametrize('times', [1, 8], ids=['3 s', 'until each was sent twice'])
@pytest.mark.parametrize('board, decoder', [
    (ModelCar, arduino.Decoder), (SensorBoard, mcu.Decoder)])
def test_chunks_are_sent_ten_times_a_second_at_first_and_then_once(board, decoder, times):
    bench = Bench(board(announcement=TEXT * times), decoder())
    size = len(chunks_of(TEXT * times, 60))
    count = max(30, 2 * size)
    chunks = announced(bench, 0.1 * count - 0.05)
    assert len(chunks) in (count - 1, count)
    assert [chunk.index for chunk in chunks] == [n % size for n in range(len(chunks))]
    assert list(filter(None, map(Assembly().add, chunks))) == [TEXT * times]
    announced(bench, 1.0)
    assert len(announced(bench, 5.0)) in (5, 6) and not any(bench.decoder.errors.values())
    assert announced(Bench(board(), decoder()), 5.0) == []


def test_the_car_announces_often_again_when_heartbeats_come_back():
    bench = Bench(ModelCar(announcement=TEXT), arduino.Decoder())
    bench.run(10.0)
    bench.output()
    for _ in range(100):
        bench.feed(arduino.encode(arduino.Heartbeat()))
        bench.run(0.01)
    assert len(announced(bench, 0.0)) in (9, 10, 11)


def answers(board, *data):
    """The replies to questions for the announcement with these DATE bytes."""
    bench = Bench(board, bus.ReplyDecoder())
    bench.feed(bus.encode_request(bus.SYNC_REQUEST) + b''.join(
        bus.encode_request(bus.Request(bus.FUNCTION, 0xFF, each)) for each in data))
    bench.run(0.01)
    return [frame.message for frame in bench.decoder.feed(bench.output())][1:]


def test_the_control_board_answers_with_the_chunk_that_it_is_asked_for():
    indices = [bytes((index,)) for index in reversed(range(CHUNKS))]
    replies = answers(ControlBoard(announcement=TEXT), *indices)
    assert [reply.data for reply in replies] == [
        chunk.pack() for chunk in reversed(chunks_of(TEXT, 60))]
    malformed = bus.Reply(bus.ERROR, bus.MALFORMED.to_bytes(2, 'little'))
    assert answers(ControlBoard(announcement=TEXT), bytes((CHUNKS,)), b'', b'\0\0') \
        == [malformed] * 3
    assert answers(ControlBoard(), b'\0') == [
        bus.Reply(bus.ERROR, bus.UNSUPPORTED.to_bytes(2, 'little'))]


def test_rows_that_are_too_many_or_too_long_cannot_be_announced():
    class Config(list):
        given = {f'row{number}': {'type': number} for number in range(17)}
    with pytest.raises(ValueError, match='17 rows in .* bytes cannot be announced'):
        announced_text('arduino', Config())
    Config.rows = {'row': {'frame_id': 'x' * 2048}}
    with pytest.raises(ValueError, match='16 in 2048 bytes'):
        announced_text('arduino', Config())
