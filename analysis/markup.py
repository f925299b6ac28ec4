"""HTML from Python values, with all text escaped. Pure functions.

Only `element` and `join` make Html; any other text that enters an element is escaped, so a name or a setting that comes
from outside cannot become markup.
"""

import html
from collections.abc import Collection, Iterable

from daedalus.protocol.texts import printable

_EMPTY = {"br", "img", "meta", "circle", "path", "line", "rect", "link"}


class Html(str):
    """Markup: text that is inserted as it is. A concatenation with other text is ordinary text again."""


Child = str | int | float | None | Iterable["Child"]


def escape(text: str) -> Html:
    """Return text as markup. What is not printable is not allowed in HTML, or reorders or hides the text around it."""
    return Html(html.escape(printable(text)))


def join(children: Child) -> Html:
    """Return children one after the other. None is left out."""
    if children is None:
        return Html()
    if isinstance(children, Html):
        return children
    if isinstance(children, str | int | float):
        return escape(str(children))
    return Html("".join(join(child) for child in children))


def element(name: str, /, *children: Child, **attributes: str | float | bool | None) -> Html:
    """Return an element.

    Args:
      name: of the element.
      children: texts, markup, or iterables of them.
      attributes: `class_` is class, `aria_label` is aria-label; None and False leave an attribute out.
    """
    written = "".join(
        f" {key.strip('_').replace('_', '-')}" + ("" if value is True else f'="{escape(str(value))}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    if name in _EMPTY:
        return Html(f"<{name}{written}>" if name in ("br", "img", "meta", "link") else f"<{name}{written}/>")
    return Html(f"<{name}{written}>{join(children)}</{name}>")


def table(
    header: Iterable[Child], rows: Iterable[Iterable[Child]], *, label: str, numeric: Collection[int] = ()
) -> Html:
    """Return a table whose first column names its rows, in a region that scrolls where it is too wide.

    Args:
      header: of the columns; empty for a table of names and values.
      rows: the cells.
      label: what the table shows, for screen readers.
      numeric: columns of numbers, counted from 0; they are aligned to the right.
    """
    head = [element("th", cell, scope="col", class_=_kind(index, numeric)) for index, cell in enumerate(header)]
    body = []
    for first, *rest in rows:
        cells = [element("td", cell, class_=_kind(index, numeric)) for index, cell in enumerate(rest, start=1)]
        body.append(element("tr", element("th", first, scope="row"), cells))
    content = element("table", element("thead", element("tr", head)) if head else None, element("tbody", body))
    return element("div", content, class_="scroll", role="region", aria_label=label, tabindex=0)


def _kind(column: int, numeric: Collection[int]) -> str | None:
    return "number" if column in numeric else None
