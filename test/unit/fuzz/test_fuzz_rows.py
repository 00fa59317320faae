"""Any rows: each is accepted, or refused with one line that names it. Nothing else is raised, and
an accepted row can be shown and published whatever the board sends."""
import sys
from io import BytesIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rospy')
from serial_communication.framing.layout import readable  # noqa: E402
from serial_communication.framing.rows import Kind, RowError  # noqa: E402
from serial_communication.ros.parameters import check  # noqa: E402

NUMBERS = st.one_of(
    st.integers(), st.floats(), st.booleans(), st.sampled_from((10**400, -10**400, 2**64, 1e-320)))
ANYTHING = st.one_of(NUMBERS, st.text(max_size=5), st.none(), st.lists(NUMBERS, max_size=3),
                     st.dictionaries(st.text(max_size=3), NUMBERS, max_size=2))
LAYOUTS = st.one_of(
    st.builds(lambda order, codes, end: order + ''.join(codes) + end, st.sampled_from('<>'),
              st.lists(st.sampled_from('bBhHqQefd?'), max_size=3),
              st.sampled_from(('', '', 's', 'B*', 'd*', '?*'))),
    st.text('<>@bBhqefd?sxpcnP*0129 \n\0é', max_size=6),
    st.sampled_from(('<50000000h', '>99999999999999999999h', '<256B', '<1025x')))
# For each type, paths that exist.
PATHS = {
    'std_msgs/Bool': ('data',), 'std_msgs/Float32': ('data',), 'std_msgs/String': ('data',),
    'sensor_msgs/JointState': ('position[1]', 'position[2]', 'position[02]', 'name[1]', 'velocity'),
    'sensor_msgs/CameraInfo': ('D', 'K[8]', 'height', 'roi.do_rectify', 'binning_x'),
    'geometry_msgs/PoseArray': ('poses[3].position.x', 'poses[999].position.y'),
    'nav_msgs/Odometry': ('pose.pose.orientation.yaw', 'pose.pose.orientation.x',
                          'pose.covariance[7]', 'child_frame_id'),
    'std_msgs/UInt8MultiArray': ('data', 'layout.dim[1].label', 'layout.data_offset'),
    'rospy/AnyMsg': ('data',), 'std_msgs': ('data',), '': ('data',), 'a/b/c': ('data',),
    'std_srvs/SetBool': ('data', 'success', 'message'), 'std_srvs/SetBoolRequest': ('data',),
    'serial_communication/Lift': ('direction', 'distance', 'status', 'message')}
NAMES = st.one_of(st.sampled_from(('force', 'class', 'None', 'imu', 'a/b')), st.text(max_size=4))
ODD_PATHS = st.one_of(st.text('ab[0].\n', max_size=5), st.just(f'data[{"9" * 5000}]'))


@st.composite
def part(draw, paths):
    """The keys for the layout of the bytes."""
    found = {'layout': draw(LAYOUTS)}
    count = sum(code in 'bBhHqQefd?s' for code in found['layout'])
    found['fields'] = draw(st.permutations((*paths, '', '', '')))[:count]
    if draw(st.integers(0, 4)) == 0:
        found['fields'] = draw(st.lists(st.one_of(ODD_PATHS, st.sampled_from(paths)), max_size=3))
    for key in 'scale', 'offset', 'minimum', 'maximum', 'invalid':
        if draw(st.integers(0, 3)) == 0:
            found[key] = draw(st.one_of(NUMBERS, st.lists(NUMBERS, min_size=count, max_size=count)))
    return found


@st.composite
def rows(draw):
    """The group of a row, its name, and the row, in which one key may have any value."""
    group = draw(st.sampled_from(('arduino/messages', 'mcu/messages', 'bus/functions')))
    kind, paths = draw(st.sampled_from(sorted(PATHS.items())))
    if group == 'bus/functions':
        row = {'cmd2': 0x30, draw(st.sampled_from(('srv_type', 'ros_type'))): kind}
        if 'ros_type' in row:
            row['period'] = 1.0
        for key in draw(st.sampled_from(((), ('request',), ('reply',), ('request', 'reply')))):
            row[key] = draw(part(paths))
    else:
        row = dict(draw(part(paths)), type=32, ros_type=kind)
        if draw(st.integers(0, 2)) == 0:
            row['constants'] = draw(st.dictionaries(
                st.one_of(st.sampled_from(paths), ODD_PATHS), ANYTHING, max_size=2))
        if draw(st.booleans()):
            row['direction'] = draw(st.sampled_from(('to_board', 'from_board')))
    for key in draw(st.lists(st.one_of(st.sampled_from(sorted(row)), st.text(max_size=3)),
                             max_size=1 if draw(st.booleans()) else 0)):
        row[key] = draw(ANYTHING)
    return group, draw(NAMES) if draw(st.integers(0, 4)) == 0 else 'force', row


@given(rows(), st.binary(max_size=64))
def test_any_row_is_accepted_or_refused_with_one_line(case, data):
    group, name, row = case
    section, rows_of = group.split('/')
    try:
        _node, boards, _unknown = check({section: {rows_of: {name: row}}})
    except RowError as error:
        assert str(error).startswith(group), error
        assert str(error) == readable(str(error)) and len(str(error)) < 1000, error
        return
    accepted, = next(values[rows_of] for binder, values in boards.items()
                     if binder.BOARD.name == section)
    row, fields = accepted.row, accepted.fields
    layout = row.message.LAYOUT if rows_of == 'messages' else row.reply
    is_command = row.kind is Kind.TO
    message = fields.new()
    for size in layout.size, layout.size + 8:      # twice, since the message is reused
        received = (data * 100)[:size] or bytes(size)
        if layout.fits(len(received)):
            values = layout.unpack(received)
            layout.text(values)
            if not is_command and not layout.implausible(values) and not fields.lacks(values):
                fields.fill(message, values).serialize(BytesIO())
    back = row.layout
    source = fields if rows_of == 'messages' else accepted.request
    if source:
        try:
            back.pack(source.read(source.new()))
        except ValueError:
            pass


def test_only_generated_modules_are_imported(tmp_path, monkeypatch):
    package = tmp_path / 'any_package'
    package.mkdir()
    (package / '__init__.py').write_text('import sys\nsys.is_imported = True\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    row = {'type': 20, 'ros_type': 'any_package/Any', 'layout': '<h', 'fields': ['data']}
    with pytest.raises(RowError, match='is not an installed type'):
        check({'arduino': {'messages': {'any': row}}})
    assert not hasattr(sys, 'is_imported')
