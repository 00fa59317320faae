"""Announced rows: their topics, services and polls are made and taken down while the bridge runs.

A link passes on each new text of its board. Everything else happens in the thread of one
LatestWorker for all links, since rospy and the master may take any time.
"""
import time
from typing import Any, Callable, Dict, Iterable, NamedTuple

import rospy

from ..boards.description import ANNOUNCED, Description
from ..framing.announcement import read_announcement
from ..framing.custom_messages import RowError, meaning
from ..framing.settings import Setting
from ..link.link import Link
from ..link.sparing_log import SparingLog
from ..transport.pace import Allowance
from .latest_worker import LatestWorker

_LINES = 60, 2.0            # log lines: at most in a burst, and then per second
_XML_RPC = 2 ** 31          # the parameter server takes no greater integer


class _Made(NamedTuple):
    """A row that is in use."""

    custom: Any                       # the custom message or function
    given: Dict[str, Any]             # the row itself
    take_down: Callable[[], None]


class AnnouncedRows:
    """The announced rows of one board.

    Args:
        board: whose `custom` reads the rows.
        link: passes on the announcements.
        configured: the custom messages or functions of the parameters; they take precedence.
        resolve: returns a row for a custom message or function: a tuple that has it as `custom`,
            with its ROS types; raises RowError.
        add: makes the topic, service or poll of such a row; returns a function that takes it down.
    """

    def __init__(self, board: Description, link: Link, configured: Iterable[Any],
                 resolve: Callable[[Any], Any],
                 add: Callable[[Any], Callable[[], None]]) -> None:
        self.link = link
        self._key = f'{board.name}/{ANNOUNCED}'
        assert board.custom, f'{board.name} has no custom rows'
        self._custom = board.custom
        self._rows_of = board.rows_of
        self._settings_prefix = board.settings.prefix if board.settings else ''
        self._configured = list(configured)
        self._resolve = resolve
        self._add = add
        self._made: Dict[str, _Made] = {}     # by name
        self._lacks_name = False     # a row is left out, since another board's has its name
        self._use_latest: Callable[[], None] = lambda: None
        self._allowance = Allowance(*_LINES)

    def serve(self, worker: LatestWorker, names: Dict[str, str], log: SparingLog,
              boards: Iterable['AnnouncedRows']) -> None:
        """Use each new announcement of the link, in the worker's thread.

        Args:
            names: see `update`.
            log: for what does not concern the link.
            boards: all of them. One whose row was left out gets it as soon as the name is free.
        """
        rows: Dict[str, Any] = {}       # that are in use

        def set_parameter() -> None:
            try:
                rospy.set_param(f'~{self.link.name}/{ANNOUNCED}', rows)
            except Exception as error:  # pylint: disable=broad-except
                # rospy passes on what its master, or another server at its address, answers.
                if not rospy.is_shutdown():
                    log.warn('parameter', f'the parameter ~{self.link.name}/{ANNOUNCED} cannot be '
                             f'set now ({error}); trying again')
                    worker.submit(set_parameter)

        def use_latest() -> None:
            nonlocal rows
            before = set(names)
            rows = for_xml_rpc(self.update(self.link.session.announcement.assembly.text or b'', names))
            set_parameter()
            if before - set(names):
                for board in boards:
                    if board._lacks_name:
                        worker.submit(board._use_latest)

        self._use_latest = use_latest
        self.link.session.announcement.on_text = lambda text: worker.submit(use_latest)

    def update(self, text: bytes, names: Dict[str, str]) -> Dict[str, Any]:
        """Make and take down what changed; return the rows that are in use now, by name.

        Args:
            text: the board's announcement.
            names: the resolved names of topics and services, and who has each; for all links.
        """
        announcement = read_announcement(text)
        self._lacks_name = False
        for problem in announcement.problems:
            self._warn(problem)
        rows = self._accepted(announcement.rows, names)
        for name in list(self._made):
            if name not in rows or meaning(rows[name].custom) != meaning(self._made[name].custom):
                self._take_down(name, names)
        self.link.session.announcement.use(text, announcement.firmware, list(self._made))
        for name, row in rows.items():
            if name not in self._made:
                self._make(row, announcement.rows[name], names)
        in_use = [name for name in rows if name in self._made]
        self.link.session.announcement.use(text, announcement.firmware, in_use)
        firmware = f' (firmware {announcement.firmware})' if announcement.firmware else ''
        if self._allowance.take(time.monotonic()):
            self.link.log.always_info(f'announces {", ".join(in_use) or "nothing"}{firmware}')
        return {name: self._made[name].given for name in in_use}

    def _accepted(self, given: Dict[str, Any], names: Dict[str, str]) -> Dict[str, Any]:
        """Return the rows that may be used, with their ROS types, by name."""
        accepted: Dict[str, Any] = {}
        for name, row in given.items():
            try:
                custom, = (self._rows_of(row) or self._custom).read({name: row}, self._key)
                if not self._is_configured(custom):
                    self._refuse_second(custom, [each.custom for each in accepted.values()], names)
                    accepted[name] = self._resolve(custom)
            except RowError as error:
                self._warn(f'an announced row is left out: {error}')
        return accepted

    def _is_configured(self, custom: Any) -> bool:
        """Return whether a row of the parameters is used instead; warn if it differs."""
        for other in self._configured:
            if custom.number == other.number or self._name(custom) == self._name(other):
                if meaning(custom) != meaning(other):
                    same = 'name' if custom.name == other.name else custom.number[0]
                    self._warn(f'the announced row {custom.name} is left out: the parameter '
                               f'{other.key} has the same {same}, differs, and takes precedence')
                return True
        return False

    def _refuse_second(self, custom: Any, others: Iterable[Any], names: Dict[str, str]) -> None:
        """Raise RowError if another row has the number or the name."""
        key, number = custom.number
        for other in others:
            if other.number == custom.number:
                raise RowError(f'{custom.key}/{key}', number,
                               f'is already the {key} of {other.name}')
        user = names.get(self._name(custom), custom.key)
        if user != custom.key:
            self._lacks_name = True
            raise RowError(custom.key, custom.name, f'has the name of {user}')

    def _make(self, row: Any, given: Dict[str, Any], names: Dict[str, str]) -> None:
        custom = row.custom
        try:
            self._made[custom.name] = _Made(custom, given, self._add(row))
            names[self._name(custom)] = custom.key
        except Exception as error:  # pylint: disable=broad-except
            self._warn(f'the announced row {custom.name} is left out: {error}')

    def _take_down(self, name: str, names: Dict[str, str]) -> None:
        del names[self._name(self._made[name].custom)]
        try:
            self._made.pop(name).take_down()
        except Exception as error:  # pylint: disable=broad-except
            self._warn(f'{name} is announced no longer, but cannot be taken down: {error}')

    def _name(self, custom: Any) -> str:
        """Return the resolved name of a row's topic, service or parameter."""
        is_setting = isinstance(custom, Setting)
        return rospy.resolve_name((self._settings_prefix if is_setting else self._custom.prefix)
                                  + custom.name)

    def _warn(self, text: str) -> None:
        if self._allowance.take(time.monotonic()) and not rospy.is_shutdown():
            self.link.log.always_warn(text)


def for_xml_rpc(value: Any) -> Any:
    """Return the value with floats for the integers that XML-RPC cannot carry."""
    if isinstance(value, dict):
        return {key: for_xml_rpc(each) for key, each in value.items()}
    if isinstance(value, list):
        return [for_xml_rpc(each) for each in value]
    return float(value) if type(value) is int and not -_XML_RPC <= value < _XML_RPC else value


def forget_announced(given: Dict[str, Any], boards: Iterable[str]) -> None:
    """Delete the rows that these boards announced before the node started.

    Args:
        given: the node's parameters.
    """
    for board in boards:
        if given.get(board, {}).pop(ANNOUNCED, None) is not None:
            rospy.delete_param(f'~{board}/{ANNOUNCED}')
