"""Private parts of rospy: used in one package only, and only if their source is known."""
import ast
import inspect
import logging
import textwrap
import threading
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import rosgraph.roslogging
import rosgraph.xmlrpc
import rospy
from rospy.impl import registration, tcpros_base, tcpros_pubsub

from serial_communication.link.sparing_log import SparingLog
from serial_communication.ros.rospy_mends import (connections, direct, handshake, log_file,
                                                  master_calls, own_names, private_parts, shortage,
                                                  shutdown)
from serial_communication.ros.rospy_mends.master_watch import MasterWatch
from sources import PACKAGE

MENDS = PACKAGE / 'ros' / 'rospy_mends'
PARTS = sorted(private_parts.SOURCES)
LOGGER = logging.getLogger('rosout')


# -- the guard --------------------------------------------------------------------------------


def known(*parts):
    """Whether the guard accepts these parts, and the warnings."""
    warnings = []
    return private_parts.are_known(parts, 'acts', 'something is missing',
                                   warnings.append), warnings


def test_the_installed_rospy_is_known():
    assert known(*PARTS) == (True, [])


@pytest.mark.parametrize('part', PARTS)
def test_another_body_with_the_same_names_is_refused(part, tmp_path):
    module, path = part.split(':')
    *owners, name = path.split('.')
    owner = vars(__import__(module, fromlist=['*']))[owners[0]] if owners else \
        __import__(module, fromlist=['*'])
    function = getattr(owner, name)
    if inspect.isclass(function):       # its first method
        owner = function
        name, function = next(item for item in vars(owner).items() if inspect.isfunction(item[1]))
    other = with_another_body(function, tmp_path / 'other.py')
    assert other.__code__.co_names == function.__code__.co_names
    with mock.patch.object(owner, name, other):
        assert known(part) == (False, ['this rospy acts differently from 1.15.15 and 1.16.0: '
                                       'something is missing'])
    assert known(part) == (True, [])


def with_another_body(function, path):
    """The function with a return before its first statement, in a file of its own."""
    lines = textwrap.dedent(inspect.getsource(function)).splitlines()
    first = ast.parse('\n'.join(lines)).body[0].body[0]
    lines.insert(first.lineno - 1, ' ' * first.col_offset + 'return None')
    path.write_text('\n'.join(lines) + '\n')
    made = {}
    exec(compile(path.read_text(), str(path), 'exec'), dict(function.__globals__), made)
    return made[function.__name__]


@pytest.mark.parametrize('problem', [AttributeError, ImportError, OSError])
def test_a_part_that_is_missing_or_has_no_source_is_refused(problem):
    with mock.patch.object(private_parts, 'source_hash', side_effect=problem):
        assert known(PARTS[0])[0] is False


def use(function, *arguments):
    """Install a patch that is needed on first use."""
    for guard in shutdown._is_known, connections._topics_are_known, connections._services_are_known:
        guard.cache_clear()
    try:
        return function(*arguments)
    finally:
        for guard in (shutdown._is_known, connections._topics_are_known,
                      connections._services_are_known):
            guard.cache_clear()


def begin_node():
    with mock.patch.object(rospy, 'init_node'):
        log_file.init_node('any')


def call_service():
    with mock.patch.object(rosgraph.Master, 'lookupService', return_value='rosrpc://nowhere:1'):
        return connections.connected_service('/any', SERVICE, 1.0).transport


SERVICE = SimpleNamespace(_type='any/Any', _md5sum='*', _request_class=rospy.AnyMsg,
                          _response_class=rospy.AnyMsg)
ONE_SUBSCRIBER = SimpleNamespace(get_num_connections=lambda: 1, impl=None)
# For each patch: how it is installed or used, and what stays as it is, with an unknown rospy.
PATCHES = {
    'direct': (lambda: direct.install(LOGGER.warning), lambda: rospy.topics.QueuedConnection),
    'handshake': (lambda: handshake.install(SparingLog('ROS', LOGGER)),
                  lambda: (tcpros_base.TCPServer.run, tcpros_base.read_ros_handshake_header)),
    'shortage': (lambda: shortage.install(SparingLog('ROS', LOGGER)),
                 lambda: (vars(rosgraph.xmlrpc.ThreadingXMLRPCServer).get('get_request'),
                          registration.threading, tcpros_pubsub.threading)),
    'log_file': (begin_node, lambda: rosgraph.roslogging.configure_logging),
    'master_calls': (lambda: master_calls.install(print, LOGGER.warning),
                     lambda: rospy.core._LockedServerProxy),
    'command_line': (lambda: master_calls.parameters_of(['_a:=1'], LOGGER.warning), dict),
    'own_names': (lambda: own_names.install(LOGGER.warning),
                  lambda: (sorted(vars(registration.get_topic_manager())),
                           sorted(vars(registration.get_service_manager())))),
    'master_watch': (lambda: MasterWatch('/any', LOGGER).start({}),
                     lambda: [each.name for each in threading.enumerate()]),
    'shutdown_hook': (lambda: use(shutdown.on_shutdown, print),
                      lambda: list(rospy.core._preshutdown_hooks)),
    'shutdown': (lambda: use(shutdown.is_shutdown_requested), rospy.is_shutdown),
    'old connections': (lambda: use(connections.NewestConnections(ONE_SUBSCRIBER).is_replaced, {}),
                        lambda: False),
    'subscribers': (lambda: use(connections.reaches, ONE_SUBSCRIBER, '/any'), lambda: True),
    'service': (lambda: use(call_service), lambda: None),
}
RESULTS = {'command_line': {}, 'shutdown': False, 'old connections': False, 'subscribers': True}


@pytest.mark.parametrize('name', PATCHES)
def test_an_unknown_rospy_works_as_it_is_and_one_warning_is_logged(name, caplog, monkeypatch):
    install, state = PATCHES[name]
    before = state()
    monkeypatch.setenv('ROS_MASTER_URI', 'http://localhost:1')
    with mock.patch.dict(private_parts.SOURCES, {part: set() for part in PARTS}):
        assert install() == RESULTS.get(name)
    assert state() == before
    warning, = [each.getMessage() for each in caplog.records]
    assert 'differently from 1.15.15 and 1.16.0: ' in warning


# -- private names elsewhere ------------------------------------------------------------------

# Of generated message classes; every ROS program in Python uses them.
GENERATED = {'_type', '_has_header', '_slot_types', '_request_class', '_response_class',
             '_md5sum', '_full_text'}
PRIVATE_MODULES = {'rosgraph.impl', 'rosgraph.roslogging', 'rosgraph.xmlrpc'}


def test_no_private_part_of_rospy_is_used_elsewhere():
    assert offenders(PACKAGE) == []


def test_every_private_part_is_found(tmp_path):
    (tmp_path / 'one.py').write_text('''
import rospy.core
from rospy.impl import registration
from rospy import topics
import rosgraph.xmlrpc
print(rospy.core.is_shutdown_requested(), topic.impl.connections, message._connection_header)
print(rospy.topics, rosgraph.roslogging, message._type, self._queue, rospy.get_time())
''')
    assert offenders(tmp_path) == [
        'one.py:2 rospy.core', 'one.py:3 rospy.impl', 'one.py:4 rospy.topics',
        'one.py:5 rosgraph.xmlrpc', 'one.py:6 message._connection_header', 'one.py:6 rospy.core',
        'one.py:6 topic.impl', 'one.py:7 rosgraph.roslogging', 'one.py:7 rospy.topics']


def offenders(package):
    """'FILE:LINE NAME' for each private part that a file outside rospy_mends uses."""
    private = private_names()
    return sorted({f'{path.relative_to(package)}:{node.lineno} {name}'
                   for path in package.rglob('*.py') if MENDS not in path.parents
                   for node in ast.walk(ast.parse(path.read_text()))
                   for name in names_in(node) if is_private(name, private)})


def private_names():
    """The names with an underscore that rospy defines or uses."""
    found = set()
    for path in Path(rospy.__file__).parent.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node, 'attr', getattr(node, 'name', None))
            if isinstance(name, str) and name.startswith('_') and not name.startswith('__'):
                found.add(name)
    return found - GENERATED | {'impl'}


def names_in(node):
    """The imports and attributes in a node, as OWNER.NAME."""
    if isinstance(node, ast.Import):
        return [each.name for each in node.names]
    if isinstance(node, ast.ImportFrom) and not node.level:
        inner = node.module.count('.')
        return [node.module] if inner else [f'{node.module}.{each.name}' for each in node.names]
    if isinstance(node, ast.Attribute) and isinstance(node.value, (ast.Name, ast.Attribute)):
        owner = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
        return [f'{owner}.{node.attr}']
    return []


def is_private(name, private):
    owner, _, attribute = name.rpartition('.')
    if owner == 'rospy':
        return attribute not in rospy.__all__
    return name in PRIVATE_MODULES or owner not in ('', 'self', 'cls') and attribute in private
