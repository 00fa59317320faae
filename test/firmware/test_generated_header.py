"""A header that `header` made, in a sketch: compiled for two chips, and run on the computer."""
import os
import subprocess
import sys

import pytest
from by_definition import cobs_encode

from compilers import HERE, ON_THE_AVR, ON_THE_ESP, check, for_the_pc, run
from emulated_board import FIRMWARE
from serial_communication.boards.arduino import custom_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.config_file import read_parameters
from serial_communication.framing.announcement import TYPE, Assembly, read_announcement

ROOT = os.path.dirname(FIRMWARE)
EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
CHIPS = {'AVR': ON_THE_AVR, 'ESP': ON_THE_ESP}


def make_header(folder, name, *arguments):
    """A header NAME.h in this folder; the arguments are those of `header`."""
    (folder / (name + '.h')).write_bytes(subprocess.check_output(
        [sys.executable, os.path.join(ROOT, 'scripts', 'header'), *map(str, arguments)]))


def make_header_of_row(folder, name, row):
    (folder / 'row.yaml').write_text(
        'arduino: {messages: {%s: {%s, fields: [data]}}}' % (name, row))
    make_header(folder, name, folder / 'row.yaml')


def run_on_the_pc(folder, sketch, received):
    """What a sketch sends if it receives these bytes."""
    status, output = run(for_the_pc(sketch, folder / 'program', '-DON_THE_PC', '-I', str(folder)))
    assert status == 0, output
    return subprocess.run([str(folder / 'program')], input=received, stdout=subprocess.PIPE,
                          check=True).stdout


@pytest.mark.parametrize('chip', sorted(CHIPS))
@pytest.mark.parametrize('link', ['arduino', 'mcu', 'bus'])
def test_the_header_of_every_example_compiles(tmp_path, link, chip):
    make_header(tmp_path, link, EXAMPLES, link)
    check(CHIPS[chip], os.devnull, '-include', str(tmp_path / f'{link}.h'))


@pytest.mark.parametrize('chip', sorted(CHIPS))
def test_a_sketch_compiles(tmp_path, chip):
    make_header(tmp_path, 'my_robot', EXAMPLES, 'arduino')
    check(CHIPS[chip], os.path.join(HERE, 'generated_sketch.cpp'), '-I', str(tmp_path))


def test_a_sketch_exchanges_values_with_the_bridge_and_announces_its_rows(tmp_path):
    make_header(tmp_path, 'my_robot', EXAMPLES, 'arduino')
    kinds = {custom.name: custom.kind for custom in custom_messages(
        read_parameters(EXAMPLES)['arduino']['messages'])}
    sent = run_on_the_pc(tmp_path, 'generated_sketch.cpp',
                         arduino.encode(kinds['gripper'](12.3, 0.5)))
    frames = arduino.Decoder(messages=kinds.values()).feed(sent)
    assert [frame.text for frame in frames if frame.type != TYPE] == [
        'force data=1.23', 'line_sensors data=[123 128]',
        'magnetic_field magnetic_field.x=-1.5e-07 magnetic_field.y=1.845e-05 '
        'magnetic_field.z=3.87e-05']
    assembly = Assembly()
    text, = filter(None, [assembly.add(frame.message) for frame in frames if frame.type == TYPE])
    assert read_announcement(text) == (
        'my_robot 1.0', read_parameters(EXAMPLES)['arduino']['messages'], [])


def test_a_command_with_a_text_takes_up_to_the_characters_of_its_struct(tmp_path):
    """The sketch sends back what it is to show."""
    make_header_of_row(tmp_path, 'display', 'type: 50, direction: to_board, '
                       'ros_type: std_msgs/String, layout: "<s"')
    for compiler in CHIPS.values():
        check(compiler, os.path.join(HERE, 'display_sketch.cpp'), '-I', str(tmp_path))
    texts = [b'', b'late', b'x' * 16, b'y' * 17]
    packets = b''.join(cobs_encode(b'\x32' + text) + b'\0' for text in texts)
    shown = run_on_the_pc(tmp_path, 'display_sketch.cpp', packets)
    assert shown == b''.join(cobs_encode(b'\x3c' + text) + b'\0' for text in texts[:3]) + (
        cobs_encode(b'\x02command 50 has 17 bytes, its struct 16\0') + b'\0')


@pytest.mark.parametrize('chip', sorted(CHIPS))
def test_a_sketch_has_the_settings_of_a_configuration(tmp_path, chip):
    (tmp_path / 'robot.yaml').write_text('''
        arduino: {settings: {
            kp: {setting: 1, layout: "<f", minimum: 0, maximum: 10, description: "a \\"gain\\"?"},
            period: {setting: 2, layout: "<I", minimum: 5}, inverted: {setting: 3, layout: "<?"},
            delay: {setting: 4, layout: "<H"}, map: {setting: 5, layout: "<H"},
            round: {setting: 6, layout: "<f"}}}
        settings: {arduino: {period: 20}}''')
    make_header(tmp_path, 'robot', tmp_path / 'robot.yaml')
    (tmp_path / 'sketch.cpp').write_text('''
        #include <PacketLink.h>
        #include "robot.h"
        SETTINGS(SETTING_VARIABLE)
        constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};
        PacketLink bridge(Serial);
        void setup() {
          bridge.announce(kAnnouncement);
          bridge.settings(kSettings);
          kp = period * 0.5f + delay_setting + map_setting + round_setting;
        }
        void loop() { bridge.update(); }''')
    check(CHIPS[chip], tmp_path / 'sketch.cpp', '-I', str(tmp_path))


def test_a_double_in_a_layout_does_not_compile_for_the_avr_and_says_why(tmp_path):
    make_header_of_row(tmp_path, 'wide', 'type: 40, ros_type: std_msgs/Float64, layout: "<d"')
    wide = '-include', str(tmp_path / 'wide.h')
    check(ON_THE_ESP, os.devnull, *wide)
    with pytest.raises(AssertionError, match='on an AVR use f in the layout'):
        check(ON_THE_AVR, os.devnull, *wide)
