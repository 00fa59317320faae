"""The program `header`: what it makes compiles, and a struct has the bytes that a decoder reads."""
import math
import os
import struct
import subprocess
import sys

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from custom_rows import layout_and_raws
from serial_communication.boards import description
from serial_communication.boards.arduino import custom_messages as arduino_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.config_file import read_parameters

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
PROGRAM = os.path.join(ROOT, 'scripts', 'header')
EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
STRICT = ('-std=c++11', '-Wall', '-Wextra', '-Wpedantic', '-Werror')


def run(*arguments):
    return subprocess.run([sys.executable, PROGRAM, *arguments], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, encoding='utf-8', timeout=60)


def made(path, *link):
    done = run(str(path), *link)
    assert (done.returncode, done.stderr) == (0, ''), done.stderr
    return done.stdout


def configuration(tmp_path, rows, link='arduino', group='messages'):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump({link: {group: rows}}))
    return path


def output(tmp_path, header, body, *options):
    """What a program with this header prints."""
    (tmp_path / 'rows.h').write_text(header)
    source, program = tmp_path / 'main.cpp', tmp_path / 'main'
    source.write_text('#include "rows.h"\n#include "rows.h"\n#include <cstdio>\n'
                      'template <class T> void show(const T& value) {\n'
                      '  for (unsigned i = 0; i < sizeof value; ++i)\n'
                      '    printf("%02x", reinterpret_cast<const uint8_t*>(&value)[i]);\n'
                      '  puts("");\n}\n' f'int main() {{\n{body}\n}}\n')
    done = subprocess.run(['g++', *STRICT, *options, str(source), '-o', str(program)],
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding='utf-8')
    assert done.returncode == 0, done.stdout
    return subprocess.check_output([str(program)], encoding='utf-8').split()


def test_structs_of_the_examples_have_the_bytes_that_the_decoder_reads(tmp_path):
    lines = output(tmp_path, made(EXAMPLES, 'arduino'), '''
        Force force = {12345};
        show(force);
        show(MagneticField{9, 1000, -32768, 32767});
        show(LineSensors<3>{{1, 2, 1023}});
        show(FirmwareVersion<6>{"1.2.3"});
        show(Bumper{true});
        Joints joints = {};
        joints.position_1 = 4096;
        show(joints);
        printf("%d %g %g %g\\n", Gripper::TYPE, Gripper::x_scale(), Gripper::x_minimum(),
               Joints::position_0_offset());''')
    kinds = {each.name: each.kind for each in arduino_messages(
        read_parameters(EXAMPLES)['arduino']['messages'])}
    decoder = arduino.Decoder(messages=kinds.values())
    names = 'force', 'magnetic_field', 'line_sensors', 'firmware_version', 'bumper', 'joints'
    texts = [decoder.feed(arduino.encode_raw(kinds[name].TYPE, bytes.fromhex(data)))[0].text
             for name, data in zip(names, lines)]
    assert texts == [
        'force data=123.45', 'magnetic_field magnetic_field.x=0.00015 '
        'magnetic_field.y=-0.0049152 magnetic_field.z=0.00491505', 'line_sensors data=[1 2 1023]',
        "firmware_version data='1.2.3'", 'bumper data=true',
        'joints position[0]=-3.14159 position[1]=3.14159']
    assert lines[len(names):] == ['48', '0.1', '-100', '-3.14159']


def test_a_struct_has_the_raw_number_that_means_no_value(tmp_path):
    """So that the sketch and the row cannot differ; in C++ of the right type, at every limit."""
    numbers = {'H': 65535, 'b': -128, 'q': -2**63, 'Q': 2**64 - 1, 'i': -2**31, 'f': -1.5,
               'd': math.inf, 'e': -1.5, '?': 0}
    path = configuration(tmp_path, {f'row_{index}': {
        'type': 20 + index, 'ros_type': 'std_msgs/Float32', 'layout': '>' + code,
        'fields': ['data'], 'invalid': number} for index, (code, number) in enumerate(
            numbers.items())})
    lines = output(tmp_path, made(path), ''.join(
        f'    Row{index} row{index};\n    row{index}.data = Row{index}::data_invalid();\n'
        f'    show(row{index});\n' for index in range(len(numbers))))
    assert lines == [struct.pack('>' + code, number).hex() for code, number in numbers.items()]
    assert '65535 raw: no value' in made(path)


@pytest.mark.parametrize('order', '<>')
def test_a_struct_with_a_time_has_a_function_that_fills_it(tmp_path, order):
    path = configuration(tmp_path, {'field': {
        'type': 50, 'ros_type': 'sensor_msgs/MagneticField', 'layout': order + 'hI',
        'fields': ['magnetic_field.x', '@time']}})
    assert output(tmp_path, made(path), """
        Field field = {};
        field.magnetic_field_x = 5;
        field.measured_at(4000000001u);
        show(field);
        printf("%u\\n", uint32_t(field.time));""") == [
            struct.pack(order + 'hI', 5, 4000000001).hex(), '4000000001']
    assert "time;  // microseconds of the board's clock" in made(path)


SETTINGS = {
    'kp': {'setting': 1, 'layout': '<f', 'minimum': 0.00001, 'maximum': 10, 'unit': '1/s',
           'description': 'a "gain"\\?'},
    'PI': {'setting': 2, 'layout': '<b'},
    'inverted': {'setting': 3, 'layout': '<?'},
    'least': {'setting': 200, 'layout': '<i', 'maximum': -5}}


def test_a_list_has_the_settings_with_their_limits_and_what_the_file_wants(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump({'arduino': {'settings': SETTINGS}, 'settings': {
        'arduino': {'kp': 2.2, 'inverted': True}}}))
    lines = output(tmp_path, made(path), '''
        #define SETTING_VARIABLE(number, variable, type, initial, ...) type variable = initial;
        #define SETTING_LINE(number, variable, type, initial, minimum, maximum, unit, what) \\
            printf("%d_%s_%s_%g_%g_%g_%s_", number, #variable, #type, double(variable), \\
                   double(minimum), double(maximum), unit); show(what);
        SETTINGS(SETTING_VARIABLE)
        SETTINGS(SETTING_LINE)''')
    assert lines == [
        '2_PI_setting_int8_t_0_-128_127__00', '3_inverted_bool_1_0_1__00',
        '1_kp_float_2.2_1e-05_10_1/s_' + b'a "gain"\\?\0'.hex(),
        '200_least_int32_t_-5_-2.14748e+09_-5__00']


@pytest.mark.parametrize('wanted, why', [
    ({'kp': 22}, 'settings/arduino/kp is 22, may be a number from 1e-05 to 10 1/s'),
    ({'inverted': 3}, 'settings/arduino/inverted is 3, may be true or false')])
def test_a_value_that_a_setting_may_not_have_is_refused(tmp_path, wanted, why):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump({'arduino': {'settings': SETTINGS},
                                    'settings': {'arduino': wanted}}))
    done = run(str(path))
    assert (done.returncode, done.stdout, done.stderr) == (1, '', f'header: {path}: {why}\n')


def test_a_message_and_a_setting_of_one_name_are_refused(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump({'mcu': {
        'messages': {'kp': {'type': 40, 'ros_type': 'std_msgs/Float32', 'layout': '<f',
                            'fields': ['data']}}, 'settings': SETTINGS}}))
    done = run(str(path))
    assert done.returncode == 1 and 'has two rows kp' in done.stderr


def test_names_of_the_time_give_way_to_fields(tmp_path):
    path = configuration(tmp_path, {'field': {
        'type': 50, 'ros_type': 'a/B', 'layout': '<IBB',
        'fields': ['@time', 'time', 'measured_at']}})
    assert output(tmp_path, made(path), """
        Field field = {};
        field.measured_at_(7);
        field.measured_at = 1;
        show(field);""") == ['070000000001']


def test_a_struct_reads_what_the_bridge_sends(tmp_path):
    kind, = [each.kind for each in arduino_messages({'grip': {
        'type': 48, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Vector3',
        'layout': '>hBf?', 'fields': ['x', 'y', 'z', 'on'], 'scale': [0.1, 1, 1, 1]}})]
    data = kind(-12.5, 200, 1.5, True).pack()
    path = configuration(tmp_path, {'grip': {
        'type': 48, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Vector3',
        'layout': '>hBf?', 'fields': ['x', 'y', 'z', 'on'], 'scale': [0.1, 1, 1, 1]}})
    assert output(tmp_path, made(path), '''
        const uint8_t bytes[] = {%s};
        Grip grip;
        memcpy(&grip, bytes, sizeof grip);
        printf("%%g %%d %%g %%d\\n", grip.x * Grip::x_scale(), grip.y, double(float(grip.z)),
               grip.on);''' % ', '.join(map(str, data))) == ['-12.5', '200', '1.5', '1']


def test_requests_and_replies_of_the_bus_have_their_structs(tmp_path):
    assert output(tmp_path, made(EXAMPLES, 'bus'), '''
        show(PumpRequest{1});
        show(TankReply{0x1234});
        show(ReadLevelReply<2>{{'o', 'k'}});
        printf("%d %d %d\\n", PumpRequest::CMD2, TankReply::CMD2, ReadLevelReply<2>::CMD2);'''
                  ) == ['01', '3412', '6f6b', '48', '50', '49']


def announced(tmp_path, header, *options):
    """The text of the announcement."""
    printed = tmp_path / 'text'
    output(tmp_path, header, f'''
        FILE* file = fopen("{printed}", "wb");
        fwrite(kAnnouncement, 1, sizeof kAnnouncement - 1, file);
        fclose(file);''', *options)
    return printed.read_bytes().decode()


def rows_of(text):
    """The rows of an announcement: one a line, each of them YAML of its own."""
    found = {}
    for line in text.splitlines():
        (name, row), = yaml.safe_load(line).items()
        found[name] = row
    return found


@pytest.mark.parametrize('link', ['arduino', 'mcu', 'bus'])
def test_the_announcement_is_the_rows(tmp_path, link):
    rows = read_parameters(EXAMPLES)[link][description(link).custom.parameter]
    assert rows_of(announced(tmp_path, made(EXAMPLES, link))) == rows


def test_the_announcement_has_no_references_and_names_that_yaml_would_change_are_quoted(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text('arduino: {messages: {"on": {type: 32, ros_type: geometry_msgs/Point, '
                    'layout: "<hh", fields: [x, y], scale: &half [0.5, 0.5], offset: *half}}}')
    text = announced(tmp_path, made(path))
    assert '*' not in text and '&' not in text
    assert rows_of(text) == read_parameters(str(path))['arduino']['messages']


def test_a_text_of_several_lines_is_announced_in_one(tmp_path):
    path = tmp_path / 'robot.yaml'
    path.write_text('''
arduino:
  settings:
    kp:
      setting: 1
      layout: "<f"
      description: >
        Proportional gain of the
        speed loop
    ki: {setting: 2, layout: "<f", description: "with a\\ttab"}
''')
    header = made(path)
    assert {name: row['description'] for name, row in rows_of(announced(tmp_path, header)).items()
            } == {'kp': 'Proportional gain of the speed loop', 'ki': 'with a tab'}
    assert 'speed loop\\n' not in header.split('kAnnouncement')[0]


def test_macros_name_the_firmware_in_the_first_line_of_the_announcement(tmp_path):
    header = made(EXAMPLES, 'mcu')
    text = announced(tmp_path, header, '-D', 'FIRMWARE_NAME="my_robot"', '-D',
                     'FIRMWARE_VERSION="1.0"')
    assert text == 'firmware: my_robot 1.0\n' + announced(tmp_path, header)


def test_more_rows_than_an_announcement_may_have_are_left_out(tmp_path):
    row = {'ros_type': 'std_msgs/Bool', 'layout': '<?', 'fields': ['data']}
    for count, is_there in ((16, True), (17, False)):
        header = made(configuration(tmp_path, {
            f'row{type_}': dict(row, type=type_) for type_ in range(20, 20 + count)}))
        assert ('kAnnouncement[]' in header) == is_there
        assert ('// No announcement: 17 rows in ' in header) != is_there


@given(st.lists(layout_and_raws(), min_size=1, max_size=12))
@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_rows_make_structs_of_the_right_size(tmp_path_factory, cases):
    folder = tmp_path_factory.mktemp('any')
    rows = {f'row_{index}': {
        'type': 20 + index, 'ros_type': 'any/Type', 'layout': layout,
        'fields': [f'f{at}' if at % 3 else '' for at in range(len(raws))],
    } for index, (layout, raws) in enumerate(cases)}
    expected = [struct.calcsize(layout.rstrip('s').replace('*', '')) + layout.endswith('s')
                for layout, _ in cases]
    shown = ['printf("%%d\\n", int(sizeof(Row%d%s)));' % (
        index, '<1>' if layout[-1] in '*s' else '') for index, (layout, _) in enumerate(cases)
        if expected[index]]
    assert output(folder, made(configuration(folder, rows)), '\n'.join(shown)) == [
        str(size) for size in expected if size]


def test_names_that_are_not_valid_or_not_unique_in_cpp_are_changed(tmp_path):
    def row(type_, fields):
        return {'type': type_, 'ros_type': 'any/Type', 'layout': f'<{len(fields)}B',
                'fields': fields}

    header = made(configuration(tmp_path, {
        'a0': row(20, ['data']), 'string': row(21, ['class', 'register']),
        'twoWords': row(22, ['a.b', 'a_b', 'c[1]', 'c_1', 'K', '', '']),
        'two_words': row(23, ['x'])}))
    assert output(tmp_path, header, '''
        show(A0Message{1}); show(StringMessage{2, 3}); show(TwoWords{4, 5, 6, 7, 8, 9, 10});
        show(TwoWordsMessage{11});
        TwoWordsMessage other = {};
        TwoWords words = {};
        printf("%d %d%d%d%d%d%d%d\\n", other.x, words.a_b, words.a_b_, words.c_1, words.c_1_,
               words.K_, words.left_out, words.left_out_);''',
                  '-D', 'A0=14', '-D', 'K=1')[:1] == ['01']


def test_the_same_file_makes_the_same_bytes(tmp_path):
    copy = tmp_path / 'elsewhere' / 'custom_messages.yaml'
    copy.parent.mkdir()
    copy.write_bytes(open(EXAMPLES, 'rb').read())
    assert made(copy, 'arduino') == made(EXAMPLES, 'arduino') == made(EXAMPLES, 'arduino')


@pytest.mark.parametrize('text, link, words', [
    ('arduino: {messages: {force: {type: 5}}}', [], 'arduino/messages/force/type is 5 (int), may'),
    ('arduino: {messages: {}}', [], 'has no custom messages: no rows in bus/functions, arduino/m'),
    ('arduino: {messages: {}}', ['mcu'], 'mcu/messages is missing'),
    ('arduino: {messages: 3}', ['arduino'], 'arduino/messages is 3 (int), may be a group of rows'),
    ('- 3', [], 'is not a table of parameters'), ('{', [], 'is not YAML'),
    ('boards: [no_such_module]', [], "importing 'no_such_module' failed"),
])
def test_a_mistake_is_one_line_and_status_1(tmp_path, text, link, words):
    path = tmp_path / 'robot.yaml'
    path.write_text(text)
    done = run(str(path), *link)
    assert (done.returncode, done.stdout) == (1, '')
    assert done.stderr.startswith(f'header: {path}: {words}') and done.stderr.count('\n') == 1


def test_rows_of_several_boards_need_the_name_of_one():
    done = run(EXAMPLES)
    assert (done.returncode, done.stderr) == (
        2, f'header: {EXAMPLES}: has rows of bus and arduino and mcu; a header is for one board: '
        'name it after the file, as mcu\n')
    done = run(EXAMPLES, 'no_board')
    assert done.returncode == 2 and done.stderr.startswith(
        f'header: {EXAMPLES}: there is no board no_board, only bus, arduino, mcu: importing')
    assert run('/no/such/file').stderr == 'header: /no/such/file: No such file or directory\n'


# Names of fields that the header, the language or a usual library has, too.
NASTY = ['x', 'x_scale', 'x_scale_', 'x_minimum', 'x_offset', 'Count', 'count', 'BigEndian',
         'TYPE', 'uint8_t', 'int16_t', 'padding', 'padding_2', 'class', 'class_', 'concept',
         'Clash', 'main', 'memcpy', 'unix', 'A0', 'bytes', 'template']


@pytest.mark.parametrize('standard', ['c++11', 'gnu++11', 'gnu++20'])
def test_fields_with_names_of_the_header_or_the_language_compile(tmp_path, standard):
    rows = {name: {'type': 40 + number, 'ros_type': 'std_msgs/Float32', 'layout': '>' + layout,
                   'fields': names, 'scale': 0.5, 'offset': 1, 'minimum': -9, 'maximum': 9}
            for number, (name, layout, names) in enumerate((
                ('clash', 'x' + 'h' * len(NASTY), NASTY), ('count', 'h*', ['data'])))}
    header = made(configuration(tmp_path, rows))
    for field in 'x', 'x_scale', 'count', 'x_scale_':
        assert f' {field};' in header
    output(tmp_path, header, f'''
        static_assert(sizeof(Clash) == {1 + 2 * len(NASTY)}, "");
        static_assert(Clash::count_scale() == 0.5f, "");''', f'-std={standard}')


def test_a_row_with_the_name_of_a_class_of_a_library_gets_another_name(tmp_path):
    row = {'ros_type': 'std_msgs/UInt8', 'layout': '<B', 'fields': ['data']}
    header = made(configuration(tmp_path, {
        name: dict(row, type=40 + number)
        for number, name in enumerate(('packet_link', 'count', 'servo', 'rate_limit'))}))
    assert sorted(line.split()[2] for line in header.splitlines()
                  if line.startswith('struct')) == [
        'CountMessage', 'PacketLinkMessage', 'RateLimitMessage', 'ServoMessage']
