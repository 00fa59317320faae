"""What a journal says of packets and times, sound and doctored."""
from campaign.packets import closed_times, packets_of
from campaign.records import Intervals

END = 100.0


def test_packets_that_stand_behind_the_rest_of_another():
    came, _made = packets_of([{'t': 1.0, 'ev': 'rx', 'raw': '0c09020b00', 'cause': 'framing',
                               'error': ''}])
    assert [packet.type for packet in came] == [11]


def test_packets_joined_by_a_lost_end():
    """Damage took the end of SPEED -141; its rest and the heartbeat behind it decode to another."""
    journal = [{'t': 1.0, 'ev': 'rx-fault', 'faults': ['rx-lose'], 'came': '040473ff00',
                'became': '0404'},
               {'t': 1.001, 'ev': 'rx', 'type': 4, 'data': '020b'}]
    came, made = packets_of(journal)
    assert [(packet.type, packet.data.hex()) for packet in came] == [(4, '73ff'), (11, '')]
    assert [(packet.type, packet.data.hex()) for packet in made] == [(4, '020b')]


def test_packets_joined_by_a_lost_end_that_are_no_packet():
    journal = [{'t': 1.0, 'ev': 'rx-fault', 'faults': ['rx-lose'], 'came': '040473ff00',
                'became': '09'},
               {'t': 1.001, 'ev': 'rx', 'raw': '09020b00', 'cause': 'framing'},
               {'t': 1.01, 'ev': 'rx', 'type': 11, 'data': ''}]
    came, made = packets_of(journal)
    assert [(packet.t, packet.type) for packet in came] == [(1.0, 4), (1.001, 11), (1.01, 11)]
    assert made == []


def test_closed_times():
    journal = [{'t': 1.0, 'ev': 'port', 'open': True}, {'t': 2.0, 'ev': 'port', 'open': False},
               {'t': 3.0, 'ev': 'port', 'open': True}]
    assert closed_times(journal, END).pairs == [(0.0, 1.0), (2.0, 3.0)]


def test_intervals():
    found = Intervals([(3, 4), (1, 2), (1.5, 2.5)])
    assert found.pairs == [(1, 2.5), (3, 4)] and found.seconds() == 2.5
    assert found.holds(2.2) and not found.holds(2.7) and found.touches(2.6, 3.1)
    assert not found.touches(2.6, 2.9) and not Intervals().holds(1)
