"""Checkpoints that are whole at every instant, and refuse to be read when they are not."""

import errno
import os
import random
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.saving import AtomicCheckpointIO

OLD, NEW = {"weight": torch.zeros(1000)}, {"weight": torch.ones(2000)}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(OLD, path)
    return path


def test_what_is_saved_is_loaded(path):
    plain = {"epoch": 3, "name": "a", "list": [1, 2.5, None]}

    AtomicCheckpointIO().save_checkpoint(plain | NEW, path)
    loaded = AtomicCheckpointIO().load_checkpoint(path)

    torch.testing.assert_close(loaded.pop("weight"), NEW["weight"])
    assert loaded == plain


class Killed(BaseException):
    """Stands for SIGKILL, which no handler of errors sees."""


STEPS = [(torch, "save"), (os, "fsync"), (zipfile.ZipFile, "testzip"), (Path, "replace")]


@pytest.mark.parametrize(("owner", "name"), STEPS, ids=[name for _, name in STEPS])
def test_a_kill_while_saving_leaves_the_old_checkpoint_whole(path, monkeypatch, owner, name):
    def kill(*args, **kwargs):
        raise Killed

    monkeypatch.setattr(owner, name, kill)
    with pytest.raises(Killed):
        AtomicCheckpointIO().save_checkpoint(NEW, path)
    monkeypatch.undo()

    torch.testing.assert_close(read_checkpoint(path), OLD)
    AtomicCheckpointIO().save_checkpoint(NEW, path)  # what the kill has left behind is in nobody's way
    torch.testing.assert_close(read_checkpoint(path), NEW)
    assert {file.name for file in path.parent.iterdir()} == {"last.ckpt", "previous.ckpt"}


def test_a_checkpoint_linked_as_previous_leaves_no_third_name(path):
    """A rename of one name of a file to another does nothing, and keeps both."""
    path.with_name("previous.ckpt").hardlink_to(path)  # as after a kill between the two renames

    AtomicCheckpointIO().save_checkpoint(NEW, path)

    assert {file.name for file in path.parent.iterdir()} == {"last.ckpt", "previous.ckpt"}


def test_a_real_kill_leaves_a_whole_checkpoint(tmp_path):
    program = """
import sys, itertools, pathlib, torch
from forbes.runs.saving import AtomicCheckpointIO
for i in itertools.count():
    AtomicCheckpointIO().save_checkpoint({"weight": torch.full((50_000,), i)}, pathlib.Path(sys.argv[1]))
    print(i, flush=True)
"""
    path = tmp_path / "last.ckpt"
    with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE, text=True) as process:
        saved = [int(process.stdout.readline()) for _ in range(5)]
        process.kill()

    assert read_checkpoint(path)["weight"].unique().numel() == 1
    assert read_checkpoint(path)["weight"][0] >= saved[-1]


def test_a_full_disk_leaves_the_old_checkpoint(path, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ForbesError, match=r"last\.ckpt: .*\(No space left on device\)"):
        AtomicCheckpointIO().save_checkpoint(NEW, path)

    torch.testing.assert_close(read_checkpoint(path), OLD)
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_a_missing_checkpoint_is_one_sentence(tmp_path):
    with pytest.raises(ForbesError, match=r"last\.ckpt: no such checkpoint"):
        AtomicCheckpointIO().load_checkpoint(tmp_path / "last.ckpt")


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_checkpoint_is_refused(path, kept):
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])

    with pytest.raises(ForbesError, match=r"last\.ckpt: truncated"):
        read_checkpoint(path)


def test_a_flipped_bit_in_a_tensor_is_refused(path):
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        member = max(archive.infolist(), key=lambda info: info.file_size)
    content[member.header_offset + 1000] ^= 1  # inside its 4,000 bytes of zeros
    path.write_bytes(content)

    with pytest.raises(ForbesError, match=r"last\.ckpt: the checkpoint is damaged"):
        read_checkpoint(path)


def directory_entries(content):
    """Where the entries of a zip file's directory begin."""
    return [match.start() for match in re.finditer(b"PK\x01\x02", content)]


def test_a_flipped_bit_never_gives_other_numbers(path):
    """Bit 4 of byte 38 of a directory entry makes it a folder, of which torch reads zeros."""
    AtomicCheckpointIO().save_checkpoint({"state_dict": {"weight": torch.arange(1.0, 9.0)}}, path)
    path.with_name("previous.ckpt").unlink()
    content, expected = path.read_bytes(), read_checkpoint(path)
    bits = [8 * (entry + byte) + bit for entry in directory_entries(content) for byte in (38, 39) for bit in range(8)]
    for place in bits + random.Random(0).sample(range(8 * len(content)), 300):
        broken = bytearray(content)
        broken[place // 8] ^= 1 << place % 8
        path.write_bytes(broken)
        try:
            torch.testing.assert_close(read_checkpoint(path), expected, rtol=0, atol=0)
        except ForbesError:
            continue


def test_a_folder_in_a_checkpoint_without_a_seal_is_refused(path):
    torch.save(NEW, path)
    content = bytearray(path.read_bytes())
    for entry in directory_entries(content):
        content[entry + 38] ^= 0x10
    path.write_bytes(content)

    with pytest.raises(ForbesError, match=r"last\.ckpt: the checkpoint is damaged"):
        read_checkpoint(path)


def test_a_damaged_checkpoint_falls_back_to_the_previous_one(path, capsys):
    AtomicCheckpointIO().save_checkpoint(NEW, path)
    path.write_bytes(path.read_bytes()[:-1] + b"?")

    torch.testing.assert_close(read_checkpoint(path), OLD)
    assert f"WARNING: {path}: truncated or damaged" in (said := capsys.readouterr().err)
    assert said.endswith(f"reading {path.with_name('previous.ckpt')}\n")

    AtomicCheckpointIO().save_checkpoint(NEW, path)  # which does not put the damaged one in the place of the whole
    torch.testing.assert_close(read_checkpoint(path), NEW)
    torch.testing.assert_close(read_checkpoint(path.with_name("previous.ckpt")), OLD)


def test_the_previous_checkpoint_is_kept_without_hard_links(path, monkeypatch):
    def refused(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    AtomicCheckpointIO().save_checkpoint(NEW, path)

    torch.testing.assert_close(read_checkpoint(path), NEW)
    torch.testing.assert_close(read_checkpoint(path.with_name("previous.ckpt")), OLD)


def test_a_checkpoint_that_would_run_code_is_refused(path, monkeypatch):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(path.parent / "evil"),)

    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    torch.save({"weight": Evil()}, path)

    with pytest.raises(ForbesError, match=r"last\.ckpt: refused, it has other objects than tensors"):
        AtomicCheckpointIO().load_checkpoint(path, weights_only=False)
    assert not (path.parent / "evil").exists()
