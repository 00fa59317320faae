"""The library's examples with one part each, in the emulator, with what is at their pins."""
import os
import struct
import subprocess
from contextlib import contextmanager

from board_ends import TIME, Car, packet
from emulated_board import FIRMWARE, EmulatedBoard
from waiting import again_if_stalled

EXAMPLES = os.path.join(FIRMWARE, 'protocol', 'examples')
OUT, IN = 32, 33      # the types of their rows


@contextmanager
def running(build, name):
    """Build an example as a sketch of one's own; run it, and yield the end of its link."""
    subprocess.run(['make', '-C', FIRMWARE, 'BUILD=' + build, 'SKETCH=' + os.path.join(
        os.path.abspath(EXAMPLES), name)], check=True, stdout=subprocess.DEVNULL)
    with EmulatedBoard(build, 'pins', image=f'sketches/{name}.elf') as board:
        end = Car(board)
        yield end
        end.port.close()


def test_a_button_is_sent_when_it_is_pressed_and_once_a_second(firmware_build):
    with running(firmware_build, 'Button') as end:
        board = end.board
        board.set('d2', 0)     # the emulator's pull-ups begin with the first change of their pin
        board.set('d2', 1)
        board.wait_until(lambda: end.read(OUT)[-1:] == [b'\0'], 2)
        end.forget()
        for level in 0, 1, 0:
            board.set('d2', level)
            board.wait_until(lambda level=level: end.read(OUT)[-1:] == [bytes([not level])], 0.5)
            end.forget()

        def once_a_second():
            end.forget()
            board.run_for(2.5)
            return end.read(OUT) in ([b'\1'] * 2, [b'\1'] * 3)
        again_if_stalled(once_a_second)


def test_a_potentiometer_has_16_readings(firmware_build):
    with running(firmware_build, 'Potentiometer') as end:
        for raw in 0, 700, 1023:
            end.board.set('a0', raw)
            end.board.wait_until(lambda raw=raw: struct.pack('<H', 16 * raw) in end.next(OUT), 2)


def test_a_sonar_measures_the_echo_of_each_pulse(firmware_build):
    with running(firmware_build, 'Sonar') as end:
        end.board.set('d2', 0)
        assert end.next(OUT, 3)[1:] == [b'\xff\xff'] * 2     # no echo
        found = set()

        def echoes():
            end.board.set('d2', 1)
            end.board.set('d2', 0)
            found.update(struct.unpack('<H', data)[0] for data in end.read(OUT))
            return [mm for mm in found if 0 < mm <= 4000]
        end.board.wait_until(echoes, 10)


def test_a_sonar_sends_the_time_of_a_pulse_with_the_pulse(firmware_build):
    """The bridge takes what delays all times by the same for the time of the line."""
    with running(firmware_build, 'Sonar') as end:
        def is_soon():
            began, ages = end.board.time, []
            end.board.reset()       # unless this test stalls before
            end.forget()

            def told():
                times = end.read(TIME)
                end.forget()
                ages.extend(end.board.time - began - struct.unpack('<I', data[:4])[0] / 1e6
                            for data in times[-1:])
                return len(ages) >= 10
            end.board.wait_until(told, 3)
            return min(ages) < 0.03     # a pulse comes each 0.05 s
        again_if_stalled(is_soon)


def test_a_servo_has_no_pulses_before_the_first_command(firmware_build):
    with running(firmware_build, 'ServoArm') as end:
        board = end.board
        start = board.time
        board.wait_until(lambda: board.time > start + 0.1, 1)
        assert board.get('pwm9') == 0
        for angle, us in (0, 1500), (90, 2400), (-90, 600), (120, 2400):
            end.send(IN, struct.pack('<h', 100 * angle))
            # The low byte of the match, in half microseconds.
            board.wait_until(lambda us=us: board.get('pwm9') == (2 * us - 1) % 256, 1)


def test_a_buzzer_sounds_for_a_second(firmware_build):
    with running(firmware_build, 'Buzzer') as end:
        board = end.board
        end.port.write(packet(IN, struct.pack('<H', 500)))
        levels = set()
        board.wait_until(lambda: levels.add(board.get('d8')) or len(levels) == 2, 1)
        start = board.time
        board.wait_until(lambda: board.time > start + 1.1, 3)
        assert {board.get('d8') for _ in range(20)} == {0.0}
