from dataclasses import dataclass

import pytest

from service.web.seats import Seats


@dataclass(eq=False)
class Somebody:
    address: str = "10.0.0.9"
    is_guest: bool = True
    must_show: bool = False


def fill(seats: Seats, addresses: list[str]) -> list[Somebody]:
    """Guests that come one after the other; whoever has to, leaves."""
    seated: list[Somebody] = []
    for address in addresses:
        if not seats.has_place(seated):
            seated.remove(seats.to_leave(seated))
        seated.append(Somebody(address, must_show=seats.must_show(seated, address)))
    return seated


def test_a_quarter_of_the_places_is_for_those_who_show_a_token():
    seated = fill(Seats(32), [f"10.0.0.{number}" for number in range(32)])
    assert [one.must_show for one in seated] == [False] * 24 + [True] * 8


@pytest.mark.parametrize(("address", "stay"), [("10.0.0.9", 8), ("127.0.0.1", 24), ("::1", 24), ("", 8)])
def test_one_address_has_a_third_of_the_others_places_but_this_machine_all(address, stay):
    seated = fill(Seats(32), [address] * 20 + [address] * 12)
    assert sum(not one.must_show for one in seated) == stay


def test_a_crowd_of_one_address_does_not_keep_newcomers_out_and_loses_its_own_oldest():
    seats = Seats(32)
    seated = fill(seats, ["10.0.0.7", *["10.0.0.9"] * 500])
    assert len(seated) == 32
    assert seated[0].address == "10.0.0.7"
    leaving = seats.to_leave(seated)
    assert leaving is next(one for one in seated if one.must_show)
    assert leaving.address == "10.0.0.9"


def test_guests_leave_for_newcomers_and_those_with_a_token_never():
    seats = Seats(4)
    owners = [Somebody(is_guest=False) for _ in range(3)]
    guest = Somebody()
    assert seats.to_leave([*owners, guest]) is guest
    assert seats.to_leave(owners) is None
