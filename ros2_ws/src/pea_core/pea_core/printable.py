"""Foreign text made safe to print: names, descriptions, the metadata of a recording.

A terminal obeys control characters, a file takes no surrogates, and right-to-left marks turn a
line around. What is shown to people passes through here once, in front of the terminal
(`pea_core.console`), plots (`pea_report.figures`) and pages (`pea_report.report`).
"""

from __future__ import annotations


def printable(text: object, most: int | None = None) -> str:
    r"""`text` in one line of printable characters; the others as Python writes them.

    Longer than `most`, it is cut in the middle.

    >>> printable("\x1b[2Jpea\n"), printable("0123456789", 7)
    ('\\x1b[2Jpea\\n', '01...89')
    """
    found = str(text)
    if not found.isprintable():
        found = "".join(c if c.isprintable() else repr(c)[1:-1] for c in found)
    if most is not None and len(found) > most:
        half = (most - 3) // 2
        found = f"{found[:half]}...{found[len(found) - half :]}"
    return found
