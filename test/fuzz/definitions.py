# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Message definitions and encodings that nobody would write."""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

from pkm_twin.bags.cdr import MessageCodec
from test.bags.conftest import DEFINITIONS
from test.fuzz.tally import Kind, refusal

WORDS = (
    "float64",
    "int8",
    "bool",
    "string",
    "wstring",
    "byte",
    "p/E",
    "E",
    "Header",
    "p/msg/M",
    "x",
    "[]",
    "[3]",
    "[<=3]",
    "<=5",
    "[99999999999]",
    "=",
    "# c",
    "=" * 80,
    "MSG: p/E",
    "MSG:",
    "\n",
    "\n",
    " ",
    " ",
    "a",
    "b",
    "class",
    "é",
    "9" * 30,
)


def definitions() -> st.SearchStrategy[str]:
    return st.lists(st.sampled_from(WORDS), max_size=25).map("".join)


class Cdr(Kind):
    """Definitions and encodings: decoded, or refused; what is encoded decodes to the same."""

    name = "definitions and CDR"

    def draw(self, rng: random.Random) -> tuple[str, bytes]:
        how = rng.randrange(3)
        if how == 0:
            definition = rng.choice(list(DEFINITIONS.values()))
        elif how == 1:
            definition = "".join(rng.choices(WORDS, k=rng.randrange(26)))
        else:
            sizes = ("", "", "[]", "[2]", "[<=2]")
            definition = "\n".join(
                f"{rng.choice(WORDS)}{rng.choice(sizes)} f{rng.randrange(10)}" for _ in range(rng.randrange(7))
            )
        words = (b"\0\0\0\0", b"\1\0\0\0", b"\xff\xff\xff\xff")
        data = b"".join(rng.choices(words, k=rng.randrange(40)))
        if rng.random() < 0.5:
            data = rng.randbytes(rng.randrange(200))
        return definition, rng.choice((b"", b"\0\1\0\0", b"\0\1\0\0", b"\0\0\0\0")) + data

    def corpus(self) -> Iterator[tuple[str, Any]]:
        """A file is a definition, a line of three dashes and the data in hexadecimal digits."""
        for name, content in super().corpus():
            definition, _, digits = content.decode().partition("\n---\n")
            yield name, (definition, bytes.fromhex(digits))

    def check(self, example: tuple[str, bytes]) -> str:
        definition, data = example

        def decode() -> None:
            codec = MessageCodec("p/msg/M", definition)
            value = codec.decode(data)
            again = codec.encode(value)
            assert codec.encode(codec.decode(again)) == again

        return refusal(decode)
