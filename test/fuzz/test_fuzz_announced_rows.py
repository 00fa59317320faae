"""Any announcements, one after the other: what is in use is always what the latest one allows, and
all that was made is taken down once."""
import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rospy')
from serial_communication.boards.arduino import DESCRIPTION  # noqa: E402
from serial_communication.framing.announcement import write_announcement  # noqa: E402
from serial_communication.framing.rows import Kind  # noqa: E402
from serial_communication.link.announcement import BoardAnnouncement  # noqa: E402
from serial_communication.link.sparing_log import SparingLog  # noqa: E402
from serial_communication.ros.binder import Binder  # noqa: E402
from serial_communication.ros.rows import read_rows  # noqa: E402

ROW = {'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']}
CONFIGURED = read_rows(DESCRIPTION, 'messages', {'mine': dict(ROW, type=40)})
rows = st.dictionaries(
    st.sampled_from(('force', 'level', 'mine', 'other', 'imu', 'pump', '2nd')),
    st.one_of(
        st.builds(lambda type_, scale: dict(ROW, type=type_, scale=scale),
                  st.integers(38, 42), st.sampled_from((1, 0.5))),
        st.builds(lambda type_: dict(ROW, type=type_, ros_type='std_msgs/Nothing'),
                  st.integers(38, 42)),
        st.builds(lambda number, layout: {'setting': number, 'layout': layout},
                  st.integers(0, 2), st.sampled_from(('<f', '<B', '>B'))),
        st.just({'type': 10}), st.just(5)), max_size=6)
texts = st.one_of(rows.map(lambda given: write_announcement(given, 'nano_car 1.1.0')),
                  st.binary(max_size=60))


class Stage(Binder):
    """A binder whose topics are only counted."""

    def __init__(self, failing=()):
        log = SparingLog('arduino', logging.getLogger('fuzz'))
        super().__init__(replace(DESCRIPTION, rows=()), SimpleNamespace(
            name='arduino', log=log, announcement=BoardAnnouncement(log)), {'messages': CONFIGURED})
        self.up = {}            # announced rows that are made, by name
        self.made = 0
        self._names = {'/unnamed/pump': 'bus/announced/pump'}
        self._failing = failing
        self.sync(self._fixed)

    def _make(self, ros_row):
        row = ros_row.row
        if not row.announced:
            return None
        assert row.name not in self.up
        assert (row.kind, row.number) not in [(each.kind, each.number) for each in self.up.values()]
        if row.name in self._failing:
            raise RuntimeError('any failure')
        self.up[row.name] = row
        self.made += 1
        return lambda: self.up.pop(row.name)

    def update(self, text):
        in_use = self.use(text)
        assert set(in_use) == set(self.up) == set(self.link.announcement.rows)
        assert self.link.announcement._in_use == text
        assert self._names == {
            '/unnamed/pump': 'bus/announced/pump', '/unnamed/mine': 'arduino/messages/mine',
            **{'/unnamed/' + DESCRIPTION.name_of(row)[1:]: f'arduino/announced/{name}'
               for name, row in self.up.items()}}
        return in_use


@given(st.lists(texts, max_size=8))
def test_what_is_in_use_is_what_the_latest_announcement_allows(sequence):
    stage = Stage()
    for text in sequence:
        in_use = stage.update(text)
        assert in_use == Stage().update(text)
        made = stage.made
        assert stage.update(text) == in_use and stage.made == made, 'the same again changes nothing'
        for name, row in in_use.items():
            used = stage.up[name]
            assert used.number == row[used.number_key]
            assert used.kind is Kind.SETTING or used.layout.values[0].scale == row['scale']
    assert stage.update(b'') == {}


@given(first=rows, second=rows)
def test_a_row_that_cannot_be_made_is_left_out_and_the_others_stand(first, second):
    stage, whole = Stage(failing=['force']), Stage()
    for given_rows in first, second:
        text = write_announcement(given_rows)
        expected = whole.update(text)
        expected.pop('force', None)
        assert stage.update(text) == expected


def test_unchanged_rows_are_not_made_again():
    stage = Stage()
    stage.update(write_announcement({'force': dict(ROW, type=38), 'level': dict(ROW, type=39)}))
    force = stage.up['force']
    stage.update(write_announcement({
        'level': dict(ROW, type=41), 'force': dict(ROW, type=38, scale=1, direction='from_board')}))
    assert stage.up['force'] is force and stage.made == 3


def test_the_parameter_of_the_rows_is_set_again_until_the_master_answers(monkeypatch):
    stage, waiting, calls = Stage(), [], []

    def set_param(name, value):
        calls.append((name, value))
        if len(calls) < 3:
            raise OSError('no route to host')

    monkeypatch.setattr('rospy.set_param', set_param)
    worker = SimpleNamespace(submit=waiting.append)
    stage._p['announcements'] = True
    stage.link.board_settings = SimpleNamespace(wanted={})
    stage.serve(worker, stage._names, [stage], {})
    text = write_announcement({'force': dict(ROW, type=38)})
    stage.link.announcement.on_text(stage.link.announcement.assembly.whole(text))
    for _ in range(3):
        waiting.pop(0)()
    assert calls == 3 * [('~arduino/announced', {'force': dict(ROW, type=38)})] and not waiting
