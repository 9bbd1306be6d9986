"""RTP: whatever is lost, doubled or out of order, a picture comes whole or not at all."""

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.sources.h264 import START_CODE
from aqualvs.sources.rtp import H264Depacketizer, Ordered, RtpOrder, RtpPacket, parse_rtp

PICTURE_S = 0.04


def header(sequence, timestamp, *, marker=False, sender=7, payload_type=96):
    return bytes([0x80, payload_type | (0x80 if marker else 0)]) + b"".join(
        value.to_bytes(n, "big") for value, n in ((sequence, 2), (timestamp, 4), (sender, 4))
    )


def unit(kind, n, seed):
    """A NAL unit with content that tells it from others."""
    return bytes([0x60 | kind]) + random.Random(seed).randbytes(n)


def picture_units(i):
    """Key pictures with parameter sets now and then, else one or two slices."""
    if i % 5 == 0:
        return [unit(7, 12, 900 + i), unit(8, 5, 950 + i), unit(5, 3000, i)]
    return [unit(1, 150, i)] if i % 2 else [unit(1, 700, i), unit(1, 1500, 500 + i)]


def packed(units, timestamp, sequence, **more):
    """Packets of a picture by RFC 6184: small units together, large ones in fragments."""
    payloads = []
    small = [u for u in units if len(u) < 100]
    if small:
        payloads.append(b"\x78" + b"".join(len(u).to_bytes(2, "big") + u for u in small))
    for whole in (u for u in units if len(u) >= 100):
        if len(whole) < 600:
            payloads.append(whole)
            continue
        pieces = [whole[at : at + 500] for at in range(1, len(whole), 500)]
        for k, piece in enumerate(pieces):
            flags = (0x80 if k == 0 else 0) | (0x40 if k == len(pieces) - 1 else 0)
            payloads.append(bytes([0x7C, flags | whole[0] & 31]) + piece)
    return [
        header((sequence + k) % 2**16, timestamp % 2**32, marker=k == len(payloads) - 1, **more)
        + payload
        for k, payload in enumerate(payloads)
    ]


def stream(n, *, first_sequence=65_500, first_time=2**32 - 10_000, **more):
    """Packets of `n` pictures, and the pictures; both counters run out on the way."""
    datagrams, pictures = [], []
    sequence = first_sequence
    for i in range(n):
        units = picture_units(i)
        made = packed(units, first_time + 3600 * i, sequence, **more)
        sequence += len(made)
        datagrams += [(i, datagram) for datagram in made]
        pictures.append(b"".join(START_CODE + u for u in units))
    return datagrams, pictures


def received(datagrams, *, interval=0.001, order=None, pictures=None, began=0.0):
    """Pass datagrams, or times at which nothing comes, to a receiver."""
    order, pictures = order or RtpOrder(), pictures or H264Depacketizer()
    found = []
    for k, datagram in enumerate(datagrams):
        for ordered in order.push(parse_rtp(datagram), began + k * interval):
            found += pictures.push(ordered)
    for ordered in order.overdue(began + len(datagrams) * interval + 1.0):
        found += pictures.push(ordered)
    return found


def test_all_pictures_come_whole_over_the_end_of_both_counters():
    datagrams, pictures = stream(40)
    found = received([d for _, d in datagrams])
    assert [u.data for u in found] == pictures
    assert not any(u.after_loss for u in found)
    assert [u.is_restart for u in found] == [True] + 39 * [False]
    assert [u.ticks - found[0].ticks for u in found] == [3600 * i for i in range(40)]


@given(st.sets(st.integers(0, 120)), st.integers(0, 3), st.integers(0, 2**20))
@settings(max_examples=150, deadline=None)
def test_a_picture_comes_whole_or_not_at_all(lost, n_shuffled, seed):
    """Losses, packets out of order by up to three places, and doubled ones."""
    datagrams, pictures = stream(30)
    rng = random.Random(seed)
    kept = [(i, d) for k, (i, d) in enumerate(datagrams) if k not in lost]
    kept = [pair for pair in kept for _ in range(1 if rng.random() < 0.95 else 2)]
    keys = [k + rng.uniform(0, n_shuffled) for k in range(len(kept))]
    kept = [pair for _, pair in sorted(zip(keys, kept, strict=True), key=lambda both: both[0])]
    found = received([d for _, d in kept])
    whole = [u.data for u in found if u.is_whole]
    assert all(data in pictures for data in whole)
    order = [pictures.index(data) for data in whole]
    assert order == sorted(set(order))
    if not found or not whole:
        return
    # Between two whole pictures that do not follow each other, the loss is told.
    for unit_before, unit_after in pairwise(found):
        if unit_before.is_whole and unit_after.is_whole and not unit_after.after_loss:
            a, b = pictures.index(unit_before.data), pictures.index(unit_after.data)
            assert b == a + 1


def test_losses_cost_no_picture_that_is_there():
    """Only the picture that misses a packet, and one whose beginning may be missing."""
    datagrams, pictures = stream(30)
    first_of_12 = next(k for k, (i, _) in enumerate(datagrams) if i == 12)
    found = received([d for k, (_, d) in enumerate(datagrams) if k != first_of_12 + 1])
    assert [pictures.index(u.data) for u in found if u.is_whole] == [
        i for i in range(30) if i != 12
    ]
    assert [u.after_loss for u in found].count(True) == 1


def test_a_missing_end_spoils_the_next_picture_unless_its_beginning_shows():
    datagrams, pictures = stream(12)
    last_of = {i: k for k, (i, _) in enumerate(datagrams)}
    found = received([d for k, (_, d) in enumerate(datagrams) if k not in (last_of[2], last_of[4])])
    # Picture 5 begins with parameter sets, picture 3 with a slice that may be its second.
    assert [pictures.index(u.data) for u in found if u.is_whole] == [0, 1, 5, 6, 7, 8, 9, 10, 11]


def test_a_late_packet_is_awaited_only_so_long():
    datagrams, _ = stream(10)
    order = RtpOrder(patience=0.02)
    packets = [parse_rtp(d) for _, d in datagrams]
    assert len(order.push(packets[0], 0.0)) == 1
    assert order.push(packets[2], 0.001) == []
    assert order.push(packets[3], 0.015) == []
    late = order.push(packets[4], 0.03)
    assert [o.packet for o in late] == packets[2:5]
    assert [o.after_loss for o in late] == [True, False, False]
    assert order.push(packets[1], 0.031) == []
    assert order.wait is None
    assert order.push(packets[6], 0.04) == []
    assert order.wait == 0.02
    assert [o.packet for o in order.overdue(0.061)] == packets[6:7]


def test_a_new_sender_is_followed_from_its_first_packet():
    one, _ = stream(6)
    other, pictures = stream(6, first_sequence=3, first_time=555, sender=8)
    order, depacketizer = RtpOrder(), H264Depacketizer()
    received([d for _, d in one], order=order, pictures=depacketizer)
    found = received(
        [d for _, d in other], order=order, pictures=depacketizer, interval=0.02, began=1.0
    )
    assert [u.data for u in found] == pictures
    assert found[0].is_restart


def test_of_two_senders_to_one_port_the_first_is_kept():
    one, pictures = stream(20)
    other, _ = stream(20, first_sequence=9000, sender=8)
    mixed = sorted(one + other, key=lambda pair: pair[0])  # Picture by picture in turn.
    assert [u.data for u in received([d for _, d in mixed])] == pictures


@pytest.mark.parametrize("flags", [(0x00, 0x40), (0x80, 0xC0), (0x80,), (0x80, None, 0x40)])
def test_fragments_without_beginning_or_end_are_no_picture(flags):
    """As a broken sender makes them, with no packet missing."""
    sets = [b"\x78" + b"".join(len(u).to_bytes(2, "big") + u for u in (unit(7, 12, 1),))]
    pieces = [
        unit(1, 50, 2) if flag is None else bytes([0x7C, flag | 5]) + bytes(60) for flag in flags
    ]
    payloads = sets + pieces
    datagrams = [
        header(k, 0, marker=k == len(payloads) - 1) + payload for k, payload in enumerate(payloads)
    ]
    assert [u.is_whole for u in received(datagrams)] == [False]


def test_a_sender_that_begins_anew_under_the_same_name_is_followed():
    one, _ = stream(6)
    again, pictures = stream(6, first_sequence=20_000, first_time=99)
    found = received([d for _, d in one + again])
    assert [u.data for u in found[-6:]] == pictures
    assert found[-6].is_restart


def test_a_stray_number_is_ignored():
    datagrams, pictures = stream(12)
    spoilt = [d for _, d in datagrams]
    stray = bytearray(spoilt[7])
    stray[2] ^= 0x40
    spoilt.insert(8, bytes(stray))
    assert [u.data for u in received(spoilt)] == pictures


def test_parameter_sets_sent_alone_go_with_the_next_picture():
    sets = [unit(7, 12, 1), unit(8, 5, 2)]
    slices = [unit(5, 3000, 3)]
    datagrams = packed(sets, 1000, 1)
    datagrams += packed(slices, 4600, 1 + len(datagrams))
    (found,) = received(datagrams)
    assert found.data == b"".join(START_CODE + u for u in sets + slices)


def test_h265_is_noticed():
    depacketizer = H264Depacketizer()
    for k in range(8):
        packet = RtpPacket(96, False, k, 0, 7, bytes([0x62, 0x01, 0x80]) + bytes(50))
        depacketizer.push(Ordered(packet, False, k == 0))
    assert depacketizer.n_foreign == 8


@pytest.mark.parametrize(
    "datagram",
    [b"", b"\x80", bytes(12), bytes([0x80, 200]) + bytes(30), bytes([0x8F, 96]) + bytes(20)],
)
def test_what_is_no_rtp_is_none(datagram):
    assert parse_rtp(datagram) is None


def test_header_extension_list_of_sources_and_padding_are_passed():
    plain = header(5, 6)
    full = bytes([plain[0] | 0x30 | 2]) + plain[1:] + bytes(8) + b"\xbe\xde\x00\x01" + bytes(4)
    packet = parse_rtp(full + b"\x65content" + b"\x00\x00\x03")
    assert packet is not None
    assert packet.payload == b"\x65content"


@given(st.binary(max_size=80))
def test_no_datagram_whatever_breaks_the_receiver(content):
    packet = parse_rtp(b"\x80\x60" + content)
    if packet is not None:
        H264Depacketizer().push(Ordered(packet, False, True))
