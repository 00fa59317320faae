"""bridge.launch: what a launch would set, without starting it. Needs ROS, but no master."""
import pytest

roslaunch = pytest.importorskip('roslaunch')

PACKAGE = 'serial_communication'
LINKS = 'bus', 'arduino', 'mcu'


def config(*arguments, path=None):
    """The configuration of this launch."""
    path = path or roslaunch.rlutil.resolve_launch_arguments([PACKAGE, 'bridge.launch'])[0]
    return roslaunch.config.load_config_default([(str(path), list(arguments))], None)


def ports(*arguments, path=None):
    """The port of each link that this launch would set."""
    given = config(*arguments, path=path).params
    return [given[f'/{PACKAGE}/{link}/port'].value for link in LINKS]


def including(path, text):
    """A launch file with this text, in which BRIDGE is the file to include."""
    path.write_text(f'<launch>{text}</launch>'.replace(
        'BRIDGE', f'file="$(find {PACKAGE})/launch/bridge.launch"'))
    return path


@pytest.mark.parametrize('arguments, expected', [
    ([], ['/dev/ttyS0', '/dev/ttyUSB0', '/dev/ttyUSB1']),
    (['bus_port:=/dev/a'], ['/dev/a', '', '']),
    (['bus_port:=/dev/a', 'arduino_port:=/dev/b'], ['/dev/a', '/dev/b', '']),
    (['bus_port:=/dev/a', 'mcu_port:='], ['/dev/a', '', ''])])
def test_where_an_argument_names_a_port_the_links_without_one_are_off(arguments, expected):
    assert ports(*arguments) == expected


@pytest.mark.parametrize('sim, expected', [
    ('false', ['/dev/ttyS0', '/dev/ttyUSB0', '']), ('true', ['/x/bus', '/x/arduino', ''])])
def test_an_empty_port_of_an_including_file_turns_its_link_off(sim, expected, tmp_path):
    path = including(tmp_path / 'robot.launch', f"""<include BRIDGE> <arg name="mcu_port" value=""/>
        <arg name="sim" value="{sim}"/> <arg name="sim_dir" value="/x"/> </include>""")
    assert ports(path=path) == expected


@pytest.mark.parametrize('sim', ['true', 'avr'])
def test_with_simulated_boards_no_real_port_is_used(sim):
    assert ports(f'sim:={sim}', 'sim_dir:=/x', 'bus_port:=/dev/a') == [
        '/x/bus', '/x/arduino', '/x/mcu']


def test_a_wrong_value_of_sim_ends_the_launch_with_a_clear_word():
    with pytest.raises(roslaunch.RLException, match='sim_is_true_false_or_avr/maybe'):
        config('sim:=maybe')


def test_several_bridges_under_one_master_have_ports_and_names_of_their_own(tmp_path):
    fleet = config(path=including(tmp_path / 'fleet.launch', ''.join(
        f"""<group ns="robot_{number}"> <include BRIDGE> <arg name="name" value="bridge"/>
            <arg name="sim" value="true"/> </include></group>""" for number in range(3))))
    used = [each.value for name, each in fleet.params.items() if name.endswith('/port')]
    nodes = [each.namespace + each.name for each in fleet.nodes]
    assert (len(set(used)), len(set(nodes))) == (9, 12)
