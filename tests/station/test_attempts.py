"""How often somebody may guess a PIN: by badge and address, by address, and over all."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.station.attempts import (
    ALL_MAX,
    FORGOTTEN_S,
    PAUSE_MAX_S,
    PAUSE_S,
    PER_ADDRESS_MAX,
    TRIES_MAX,
    Attempts,
    BackOff,
)

X, Y = "192.0.2.1", "192.0.2.2"


def used_up(attempts: Attempts, now: float, address: str = X, badge: str = "B") -> None:
    for _ in range(TRIES_MAX):
        assert attempts.begin(address, badge, now) == 0.0


def test_a_try_counts_before_it_is_checked() -> None:
    attempts = Attempts()
    waits = [attempts.begin(X, "B", 0.0) for _ in range(40)]
    assert waits == [0.0] * TRIES_MAX + [PAUSE_S] * (40 - TRIES_MAX)


def test_each_pause_takes_twice_as_long_up_to_a_limit() -> None:
    attempts, now, pauses = Attempts(), 0.0, []
    for _ in range(7):
        used_up(attempts, now)
        pauses.append(attempts.begin(X, "B", now))
        assert attempts.begin(X, "B", now + pauses[-1] - 0.1) > 0.0
        now += pauses[-1]
    assert pauses == [60.0, 120.0, 240.0, 480.0, PAUSE_MAX_S, PAUSE_MAX_S, PAUSE_MAX_S]


def test_refused_tries_do_not_make_the_pause_longer() -> None:
    attempts = Attempts()
    used_up(attempts, 0.0)
    for now in range(1, 60):
        assert attempts.begin(X, "B", float(now)) == PAUSE_S - now
    assert attempts.begin(X, "B", PAUSE_S) == 0.0


def test_a_right_try_ends_the_growth_and_not_the_rate() -> None:
    attempts = Attempts()
    used_up(attempts, 0.0)
    attempts.forget(X, "B")
    assert attempts.begin(X, "B", 1.0) == 59.0
    used_up(attempts, 60.0)
    assert attempts.begin(X, "B", 60.0) == PAUSE_S


def test_who_tries_no_more_is_forgotten() -> None:
    back_off = BackOff()
    for _ in range(2 * TRIES_MAX):
        back_off.count(0.0)
    assert back_off.wait_s(0.0) == 2 * PAUSE_S
    later = FORGOTTEN_S + 1.0
    for _ in range(TRIES_MAX):
        back_off.count(later)
    assert back_off.wait_s(later) == PAUSE_S


def test_a_badge_that_is_attacked_signs_in_at_another_address() -> None:
    attempts = Attempts()
    used_up(attempts, 0.0)
    assert attempts.begin(X, "B", 0.0) == PAUSE_S
    assert attempts.begin(Y, "B", 0.0) == 0.0
    assert attempts.begin(X, "C", 0.0) == 0.0


def test_one_client_does_not_use_up_the_tries_of_all() -> None:
    attempts = Attempts()
    allowed = [each for each in range(1000) if attempts.begin(X, str(each), 0.0) == 0.0]
    assert len(allowed) == PER_ADDRESS_MAX
    assert attempts.begin(Y, "B", 0.0) == 0.0


def test_all_clients_together_have_a_limit() -> None:
    attempts = Attempts()
    allowed = [each for each in range(1000) if attempts.begin(str(each), "B", 0.0) == 0.0]
    assert len(allowed) == ALL_MAX
    assert attempts.begin(Y, "B", 59.9) > 0.0
    assert attempts.begin(Y, "B", 60.0) == 0.0


@pytest.mark.slow
def test_memory_stays_small_under_guesses_without_end() -> None:
    attempts = Attempts()
    for number in range(4000):
        attempts.begin(f"{number % 700}", f"{number}", number * 2.0)
        assert len(attempts._badges) <= 2000
        assert len(attempts._addresses) <= 1001


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.floats(0.0, 90.0), st.sampled_from([X, Y]), st.booleans()), max_size=80)
)
def test_in_no_minute_more_than_five_of_a_badge_and_address(
    steps: list[tuple[float, str, bool]],
) -> None:
    attempts, now = Attempts(), 0.0
    checked: dict[str, list[float]] = {X: [], Y: []}
    for pause_s, address, is_right in steps:
        now += pause_s
        wait_s = attempts.begin(address, "B", now)
        if wait_s == 0.0:
            checked[address].append(now)
            if is_right:
                attempts.forget(address, "B")
    for moments in checked.values():
        for begun in moments:
            assert sum(begun <= each < begun + 59.999 for each in moments) <= TRIES_MAX
