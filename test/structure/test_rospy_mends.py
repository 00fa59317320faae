"""Private parts of rospy: used in one package only, and only if their source is known."""
import ast
import importlib
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
                                                  master_calls, master_watch, own_names,
                                                  private_parts, shortage, shutdown)
from sources import PACKAGE

MENDS = PACKAGE / 'ros' / 'rospy_mends'
LOGGER = logging.getLogger('rosout')
MODULES = (connections, direct, handshake, log_file, master_calls, master_watch, own_names,
           shortage, shutdown)
GUARDS = [(f'{module.__name__.rpartition(".")[2]}.{name}', guard) for module in MODULES
          for name, guard in vars(module).items() if isinstance(guard, private_parts.Guard)]


# -- the guards -------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def fresh_guards():
    """Each test has guards that have not been asked yet."""
    for _name, guard in GUARDS:
        guard._passed = None
    yield
    for _name, guard in GUARDS:
        guard._passed = None


def test_every_module_of_the_package_is_here():
    with_guard = {path.stem for path in MENDS.glob('*.py') if 'Guard(' in path.read_text()}
    assert with_guard - {'private_parts'} == {name.partition('.')[0] for name, _guard in GUARDS}


@pytest.mark.parametrize('guard', [guard for _name, guard in GUARDS], ids=dict(GUARDS))
def test_the_installed_rospy_is_known(guard):
    warnings = []
    assert guard.passes(warnings.append) is True and warnings == []


@pytest.mark.parametrize('guard, part', [
    pytest.param(guard, part, id=f'{name} {part}') for name, guard in GUARDS
    for part in guard.parts])
def test_another_body_with_the_same_names_is_refused(guard, part, tmp_path):
    module, _, path = part.partition(':')
    owner_path, _, name = path.rpartition('.')
    owner = importlib.import_module(module)
    owner = getattr(owner, owner_path) if owner_path else owner
    function = getattr(owner, name)
    if inspect.isclass(function):       # its first method
        owner = function
        name, function = next(item for item in vars(owner).items() if inspect.isfunction(item[1]))
    other = with_another_body(function, tmp_path / 'other.py')
    assert other.__code__.co_names == function.__code__.co_names
    warnings = []
    with mock.patch.object(owner, name, other):
        assert guard.passes(warnings.append) is False
        assert guard.passes(warnings.append) is False
    assert len(warnings) == 1 and 'differently from 1.15.15 and 1.16.0: ' in warnings[0]


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
    guard = private_parts.Guard('rospy:spin', set(), 'acts', 'something is missing')
    with mock.patch.object(guard, 'source_hash', side_effect=problem):
        assert guard.passes(lambda _warning: None) is False


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
    'master_watch': (lambda: master_watch.MasterWatch('/any', LOGGER).start({}),
                     lambda: [each.name for each in threading.enumerate()]),
    'shutdown_hook': (lambda: shutdown.on_shutdown(print),
                      lambda: list(rospy.core._preshutdown_hooks)),
    'shutdown': (lambda: shutdown.is_shutdown_requested(), rospy.is_shutdown),
    'old connections': (lambda: connections.NewestConnections(ONE_SUBSCRIBER).is_replaced({}),
                        lambda: False),
    'subscribers': (lambda: connections.reaches(ONE_SUBSCRIBER, '/any'), lambda: True),
    'service': (call_service, lambda: None),
}
RESULTS = {'command_line': {}, 'shutdown': False, 'old connections': False, 'subscribers': True}


@pytest.mark.parametrize('name', PATCHES)
def test_an_unknown_rospy_works_as_it_is_and_one_warning_is_logged(name, caplog, monkeypatch):
    install, state = PATCHES[name]
    before = state()
    monkeypatch.setenv('ROS_MASTER_URI', 'http://localhost:1')
    with mock.patch.object(private_parts, '_source', return_value='unknown'):
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


def test_a_server_that_was_shut_down_before_its_thread_ran_ends_without_an_error():
    server = tcpros_base.TCPServer(lambda *_connection: None)
    server.shutdown()
    handshake._Acceptor(server, {}, SparingLog('ROS', LOGGER)).run()
