"""Custom messages that simulated boards send, and custom functions that they answer."""
import os

import pytest
from lines import ROOT
from simulation_bench import Bench

from serial_communication.boards import BOARDS, description
from board_rows import car_messages, functions
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.boards.config_file import board_parameters, read_parameters
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.framing.rows import Kind
from serial_communication.simulation.custom_messages import simulated_values

EXAMPLES = read_parameters(os.path.join(ROOT, 'config', 'custom_messages.yaml'))
FUNCTIONS, CAR, SENSORS = (
    board.read_all(board_parameters(EXAMPLES, board.name))
    for board in map(description, BOARDS))


@pytest.mark.parametrize('own, board, decoder', [
    (CAR, ModelCar(custom=CAR), arduino.Decoder),
    (SENSORS, SensorBoard(custom=SENSORS), mcu.Decoder)], ids=('arduino', 'mcu'))
def test_every_message_of_the_examples_is_played_within_its_limits(own, board, decoder):
    kinds = [message.message for message in own if message.kind is Kind.FROM]
    bench = Bench(board, decoder(messages=kinds))
    bench.run(20.0001)
    frames = bench.decoder.feed(bench.output())
    assert not any(frame.cause for frame in frames) and sum(bench.decoder.errors.values()) == 0
    for kind in kinds:
        played = [frame.message for frame in frames if type(frame.message) is kind]
        assert len(played) == 200
        assert len({message.pack() for message in played}) > 1, 'the values do not change'


def test_a_received_command_of_the_examples_is_printed():
    bench = Bench(ModelCar(custom=CAR), arduino.Decoder())
    gripper, = [message.message for message in CAR if message.kind is Kind.TO]
    bench.feed(arduino.encode(gripper(12.5, 0.5)))
    assert [text for text in bench.said if 'gripper' in text] == ['gripper x=12.5 z=0.501961']


@pytest.mark.parametrize('values, range_of', [
    ({'layout': '<b'}, (-100, 100)), ({'layout': '<B'}, (0, 100)),
    ({'layout': '<f', 'minimum': 1e6}, (1e6, 1e6 + 200)),
    ({'layout': '<h', 'maximum': -5000}, (-5200, -5000)),
    ({'layout': '<B', 'scale': -2, 'minimum': -7, 'maximum': -3}, (-6, -4)),
    ({'layout': '<?'}, (0, 1)), ({'layout': '<d', 'minimum': 3, 'maximum': 3}, (3, 3))])
def test_simulated_values_cover_their_range_and_stay_in_it(values, range_of):
    custom, = car_messages({'any': dict(values, type=99, ros_type='a/B', fields=['data'])})
    layout = custom.layout
    numbers = [layout.unpack(layout.pack(simulated_values(layout, tick / 7)))[0]
               for tick in range(500)]
    assert min(numbers) >= range_of[0] and max(numbers) <= range_of[1]
    assert max(numbers) - min(numbers) >= 0.9 * (range_of[1] - range_of[0])


def test_no_value_is_played_sometimes():
    custom, = car_messages({'any': dict(type=99, ros_type='a/B', layout='<Hh*', minimum=0,
                                        fields=['a', 'b'], maximum=9, invalid=[65535, -1])})
    layout = custom.layout
    texts = [layout.text(layout.unpack(layout.pack(simulated_values(layout, tick / 10))))
             for tick in range(100)]
    assert sum('a=none' in text for text in texts) == 10
    assert sum(text.partition('b=')[2].count('none') for text in texts) == 4 * 10


def test_a_simulated_text_is_cut_to_its_place():
    custom, = car_messages({'any': dict(type=99, ros_type='a/B', layout='<3s2xs',
                                        fields=['a', 'b'])})
    assert simulated_values(custom.layout, 5.0) == ('sim', 'simulated 5')


@pytest.mark.parametrize('board, wire', [(ModelCar, arduino), (SensorBoard, mcu)])
def test_a_row_with_a_time_has_that_of_the_boards_clock(board, wire):
    row, = description(board.NAME).read('messages', {'force': {
        'type': 40, 'ros_type': 'a/B', 'layout': '<hI', 'fields': ['x', '@time']}})
    bench = Bench(board(custom=[row]), wire.Decoder(messages=[row.message]))
    bench.run(1.05)
    times = [message[1] for message in bench.messages(row.message)]
    assert times == pytest.approx([100_000 * number for number in range(1, 11)], abs=1)


def asked(bench, request):
    """Send one request; return the reply."""
    bench.feed(bus.encode_request(bus.SYNC_REQUEST) + bus.encode_request(request))
    bench.run(0.01)
    return [frame.message for frame in bench.decoder.feed(bench.output())][-1]


def test_custom_functions_are_answered():
    bench = Bench(ControlBoard(custom=FUNCTIONS), bus.ReplyDecoder())
    by_name = {function.name: function for function in FUNCTIONS}
    assert asked(bench, by_name['pump'].make_request((True,))) == bus.Reply(bus.OK)
    assert bench.said[-1] == 'pump data=true'
    level = asked(bench, by_name['read_level'].make_request(()))
    assert by_name['read_level'].reply.unpack(level.data)[0].startswith('simulated')
    tank = asked(bench, by_name['tank'].make_request(()))
    assert 0 <= by_name['tank'].reply.unpack(tank.data)[0] <= 655350
    assert asked(bench, bus.Request(bus.FUNCTION, 0x30)).error_code == bus.MALFORMED
    assert asked(bench, bus.Request(bus.FUNCTION, 0x33)).error_code == bus.UNSUPPORTED


def test_a_custom_function_refuses_a_value_outside_its_limits():
    own = functions({'speed': {
        'cmd2': 0x40, 'srv_type': 'a/B',
        'request': {'layout': '<B', 'fields': ['speed'], 'maximum': 10}}})
    bench = Bench(ControlBoard(custom=own), bus.ReplyDecoder())
    for speed, cmd1 in ((10, bus.OK), (11, bus.ERROR)):
        assert asked(bench, bus.Request(bus.FUNCTION, 0x40, bytes((speed,)))).cmd1 == cmd1
