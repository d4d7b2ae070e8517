from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from store_samples import sample_recipe, sample_record, sample_registration

from data_contracts.run import RunRecord
from data_contracts.work import Recipe
from worldpose.errors import CorruptionError, InputError
from worldpose.store.canonical import canonical_json, digest
from worldpose.store.documents import seal, unseal

DOCUMENT = seal(sample_record("0001", sample_recipe()))


def test_record_comes_back() -> None:
    record = sample_record("0001", sample_recipe())
    assert unseal(RunRecord, seal(record), "run") == record
    assert seal(unseal(RunRecord, seal(record), "run")) == seal(record)


@given(st.integers(0, len(DOCUMENT) - 1), st.integers(0, 7))
def test_every_flipped_bit_is_corruption(index: int, bit: int) -> None:
    flipped = bytearray(DOCUMENT)
    flipped[index] ^= 1 << bit
    with pytest.raises(CorruptionError, match="the place is damaged"):
        unseal(RunRecord, bytes(flipped), "the place")


@given(st.integers(0, len(DOCUMENT) - 1))
def test_every_truncation_is_corruption(length: int) -> None:
    with pytest.raises(CorruptionError):
        unseal(RunRecord, DOCUMENT[:length], "the place")


@given(st.binary(max_size=200))
def test_noise_is_corruption(noise: bytes) -> None:
    with pytest.raises(CorruptionError):
        unseal(RunRecord, noise, "the place")


@pytest.mark.parametrize("data", [b"[]", b"1", b"null", b"{}", b"[" * 100_000, DOCUMENT + b" "])
def test_other_json_is_corruption(data: bytes) -> None:
    with pytest.raises(CorruptionError):
        unseal(RunRecord, data, "the place")


def test_whole_document_of_another_kind_is_corruption() -> None:
    with pytest.raises(CorruptionError, match="is not a Recipe"):
        unseal(Recipe, seal(sample_registration()), "the place")


def test_document_of_a_later_contract_is_refused_as_such() -> None:
    fields = {"contract": 7, "something": "new"}
    sealed = {**fields, "checksum": digest(canonical_json(fields))}
    with pytest.raises(InputError, match="found contract 7"):
        unseal(Recipe, canonical_json(sealed) + b"\n", "the place")
