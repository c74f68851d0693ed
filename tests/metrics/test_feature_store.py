"""Rows in files: whoever wrote them, and in whichever order."""

import copy
import pickle
import tempfile

import pytest
import torch

from r2flow.metrics.store import FeatureStore


@pytest.fixture
def rows():
    return torch.randn(11, 3, generator=torch.Generator().manual_seed(0))


def read(store):
    return torch.cat([block for _, block in store.blocks(4)]).float()


def test_rows_are_read_by_number_however_they_were_written(rows, tmp_path):
    stores = [FeatureStore("real", tmp_path) for _ in range(2)]
    for k in (8, 0, 4):
        stores[k % 3 % 2].write(k, rows[k : k + 4])
    for store in stores:
        assert len(store) == 11
        assert torch.equal(store.tensor(), rows)
        assert torch.equal(read(store), rows)
    assert [where for where, _ in stores[0].blocks(4)] == [slice(0, 4), slice(4, 8), slice(8, 11)]


def test_rows_without_numbers_are_left_out(rows):
    store = FeatureStore("real")
    holed = rows.clone()
    holed[4] = torch.nan
    holed[9, 1] = torch.inf
    store.write(0, holed)
    kept = torch.cat([rows[:4], rows[5:9], rows[10:]])
    assert len(store) == 9
    assert torch.equal(store.tensor(), kept)
    assert torch.equal(read(store), kept)


def test_what_is_made_of_the_rows_does_not_change_the_file(rows):
    store = FeatureStore("real")
    store.write(0, rows)
    store.tensor().zero_()
    assert torch.equal(store.tensor(), rows)


def test_a_new_round_begins_with_nothing_and_copies_are_their_own(rows):
    store = FeatureStore("real")
    store.write(0, rows)
    for other in (copy.deepcopy(store), pickle.loads(pickle.dumps(store))):
        other.clear()
        assert len(other) == 0
        other.write(0, rows[:2])
    assert torch.equal(store.tensor(), rows)
    store.clear()
    assert len(store) == 0
    assert store.tensor().shape == (0, 0)


def test_a_process_that_clears_first_takes_nothing_from_one_that_still_reads(rows, tmp_path):
    fast, slow = FeatureStore("real", tmp_path), FeatureStore("real", tmp_path)
    fast.write(0, rows)
    fast.clear()
    fast.write(0, rows[:3])
    assert torch.equal(slow.tensor(), rows)
    slow.clear()
    assert torch.equal(slow.tensor(), rows[:3])
    fast.clear()
    assert len(list(tmp_path.iterdir())) == 2  # rows and flags of the last round: those before it are gone


def test_nothing_of_it_lies_in_the_temporary_folder(rows, tmp_path, monkeypatch):
    """What has no name is gone with its process, also with a killed one."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    store = FeatureStore("real")
    store.write(0, rows)
    assert torch.equal(store.tensor(), rows)
    assert list(tmp_path.iterdir()) == []
