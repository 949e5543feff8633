# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What once fell stays refused, each by an error of the package: one file a fault."""

import pytest

from test.fuzz.__main__ import KINDS
from test.fuzz.bags import NonsenseBags
from test.fuzz.definitions import Cdr
from test.fuzz.files import Csv, Metadata, Yaml
from test.fuzz.messages import Messages
from test.fuzz.tally import CORPUS, Tally, batch, refusal

FILES = sorted(path for path in CORPUS.rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The kinds, each made once."""
    kinds = {}

    def make(kind):
        if kind not in kinds:
            kinds[kind] = kind(tmp_path_factory.mktemp(kind.__name__))
        return kinds[kind]

    return make


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_it_is_refused(made, kind):
    subject = made(kind)
    for name, example in subject.corpus():
        assert subject.check(example) != "good", name


def test_messages_at_random(made):
    """Refused, or answered as an independent rule and the model say, on every robot in turn."""
    found = Tally("messages")
    for seed in range(16):
        batch(made(Messages), found, seed, 100)
    assert not found.failures
    assert found.good > 0.3 * found.examples and len(found.refused) > 15


SOME = {Yaml: 80, Csv: 20, Metadata: 40, Cdr: 500, NonsenseBags: 30}
"""Examples by default; `make fuzz` draws for as long as it is told, of all kinds."""


@pytest.mark.parametrize("kind", SOME, ids=lambda kind: kind.__name__)
def test_examples_at_random(made, kind):
    found = Tally(kind.name)
    batch(made(kind), found, 1, SOME[kind])
    assert not found.failures
    assert found.examples >= SOME[kind] and found.refused


def test_every_file_is_of_a_kind():
    assert {path.parent.name for path in FILES} <= {kind.__name__ for kind in KINDS}
    assert len(FILES) > 50


def test_an_error_of_another_kind_is_no_refusal():
    with pytest.raises(ZeroDivisionError):
        refusal(lambda: 1 / 0)
