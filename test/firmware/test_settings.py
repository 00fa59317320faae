"""Settings of a sketch: what it answers, and when it reports them."""
import struct

from by_definition import arduino_at, mcu_at

SETTING, MCU_SETTING, ANNOUNCEMENT = 253, 0xFD, 255
NUMBERS = [1, 2, 3, 4, 5, 200]      # those of library_cases.cpp, in the order of their table


def packets_of(output):
    """The (ms, packet) of the lines that the port prints."""
    return [(int(line.split()[0]), arduino_at(bytes.fromhex(line.split()[1]), 0))
            for line in output.splitlines()]


def reports(packets):
    return [(ms, packet.data[0]) for ms, packet in packets if packet.type == SETTING]


def test_settings_are_reported_after_the_start_and_then_in_turn(library_case):
    found = reports(packets_of(library_case('settings_alone_in_packets')))
    assert found == list(enumerate(NUMBERS)) + [
        (1000 * (index + 1), NUMBERS[index % 6]) for index in range(19)]


def test_a_sensor_board_reports_them_likewise(library_case):
    lines = [line.split() for line in library_case('settings_alone_in_frames').splitlines()]
    frames = [(int(ms), mcu_at(bytes.fromhex(frame), 0)) for ms, frame in lines]
    assert [(ms, frame.data[0]) for ms, frame in frames] == list(enumerate(NUMBERS)) + [
        (1000 * (index + 1), NUMBERS[index % 6]) for index in range(19)]
    assert all(frame.type == MCU_SETTING for _, frame in frames)


def test_settings_follow_the_chunks_of_an_announcement(library_case):
    packets = packets_of(library_case('settings_beside_the_packets_of_the_car'))
    chunks = [ms for ms, packet in packets if packet.type == ANNOUNCEMENT]
    own = [(ms, number) for ms, number in reports(packets) if number != 2]
    assert [number for _, number in own[:5]] == [1, 3, 4, 5, 200]
    in_turn = [number for number in NUMBERS * 20 if number != 2]
    assert [number for _, number in own[5:]] == in_turn[:len(own) - 5]
    assert len(own) - 5 > len(chunks) * 4 // 6
    # Every setting that arrives is answered within the 10 ms of the sketch's own packets.
    answers = [ms for ms, number in reports(packets) if number == 2]
    assert all(any(0 <= answer - ms < 10 for answer in answers) for ms in range(0, 9000, 50))


def test_an_answer_waits_for_room_and_all_are_given(library_case):
    packets = packets_of(library_case('settings_through_a_full_port'))
    assert [(ms, packet.data) for ms, packet in packets if packet.data[0] in (2, 4) and ms > 160][
        :4] == [(350, b'\x02' + struct.pack('<H', 16)), (351, b'\x04\x07'),
                (550, b'\x02' + struct.pack('<H', 16)), (551, b'\x04\x07')]
