"""Declarations with sessions that record what is declared in them, and calls in the middle of other calls."""

from collections.abc import Callable
from typing import Any, cast

import pytest
import zenoh

from daedalus.transport.zenoh_declarations import Declarations, Declare


class Session:
    """A session in which declarations are names; a closed one refuses them."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.closed = False

    def close(self) -> None:
        self.closed = True
        self.names.clear()


class Declared:
    def __init__(self, session: Session, name: str) -> None:
        self._session, self._name = session, name

    def undeclare(self) -> None:
        if self._session.closed:
            raise zenoh.ZError("session closed")
        self._session.names.remove(self._name)


def declaring(name: str, before: Callable[[Session], object] = lambda _: None) -> Declare:
    """Return a declaration; `before` is called first, with the session."""

    def declare(session: Any) -> Declared:
        before(session)
        if session.closed:
            raise zenoh.ZError("session closed")
        session.names.append(name)
        return Declared(session, name)

    return declare


@pytest.fixture
def sessions() -> tuple[Session, Session, Declarations]:
    """Return the present session, the next one, and the declarations."""
    old, new = Session(), Session()
    return old, new, Declarations(cast(Any, old))


def test_declarations_are_repeated_in_their_order(sessions: tuple[Session, Session, Declarations]) -> None:
    old, new, declarations = sessions
    first, second, third = (declaring(name) for name in ("first", "second", "third"))
    for declare in (first, second, third):
        declarations.add(declare)
    declarations.remove(second)
    declarations.remove(second)
    assert old.names == ["first", "third"]
    declarations.move_to(cast(Any, new))
    assert old.closed
    assert new.names == ["first", "third"]
    declarations.remove(first)
    assert new.names == ["third"]


def test_declaration_during_the_repetition_is_made_once(sessions: tuple[Session, Session, Declarations]) -> None:
    _, new, declarations = sessions
    added: list[Declare] = []

    def add(session: Session) -> None:
        if session is new:
            added.append(declaring("added"))
            declarations.add(added[0])

    declarations.add(declaring("first", add))
    declarations.move_to(cast(Any, new))
    assert new.names == ["added", "first"]
    declarations.remove(added[0])
    assert new.names == ["first"]


def test_declaration_that_is_withdrawn_during_its_repetition_is_not_made(
    sessions: tuple[Session, Session, Declarations],
) -> None:
    _, new, declarations = sessions

    def withdraw(session: Session) -> None:
        if session is new:
            declarations.remove(itself)
            declarations.remove(later)

    itself, later = declaring("itself", withdraw), declaring("later")
    for declare in (itself, later):
        declarations.add(declare)
    declarations.move_to(cast(Any, new))
    assert new.names == []


@pytest.mark.parametrize("refuses", [True, False])
def test_declaration_in_a_session_that_is_replaced_is_made_in_the_next(
    sessions: tuple[Session, Session, Declarations], refuses: bool
) -> None:
    old, new, declarations = sessions

    def replace(session: Session) -> None:
        if session is old:
            declarations.move_to(cast(Any, new))
            old.closed = refuses  # a session may also accept a declaration just before it is closed

    declare = declaring("only", replace)
    declarations.add(declare)
    assert new.names == ["only"]
    declarations.remove(declare)
    assert new.names == []


def test_refused_declaration_is_not_repeated(sessions: tuple[Session, Session, Declarations]) -> None:
    old, new, declarations = sessions
    old.close()
    with pytest.raises(zenoh.ZError, match="session closed"):
        declarations.add(declaring("refused"))
    declarations.move_to(cast(Any, new))
    assert new.names == []
