"""What changes in a run folder: a copy that gets only that is the same."""

from pathlib import Path

from forbes.commands.launchers.changes import changes, write_changes
from forbes.files import append_whole, replace_file


def test_only_what_has_changed_is_sent(tmp_path):
    run, sent = tmp_path / "run", tmp_path / "sent"
    for name in ("checkpoints/last.ckpt", "episodes/0.npz", "episodes/1.npz", "metrics.jsonl", ".lock"):
        replace_file(run / name, name.encode())
    known = {}
    first = changes(str(run), known)
    write_changes(sent, first)
    assert next(iter(first)) == "checkpoints/last.ckpt"
    assert changes(str(run), known) == {}

    (run / "episodes" / "0.npz").unlink()
    replace_file(run / "checkpoints" / "last.ckpt", b"new")
    append_whole(run / "metrics.jsonl", b", more")
    then = changes(str(run), known)
    write_changes(sent, then)

    assert then == {"episodes/0.npz": None, "checkpoints/last.ckpt": b"new", "metrics.jsonl": b"metrics.jsonl, more"}
    assert not (sent / "episodes" / "0.npz").exists()
    assert (sent / "checkpoints" / "last.ckpt").read_bytes() == b"new"


def test_a_file_that_is_deleted_while_it_is_read_is_no_loss(tmp_path, monkeypatch):
    replace_file(tmp_path / "episodes" / "0.npz", b"")
    monkeypatch.setattr(Path, "read_bytes", lambda path: path.unlink() or open(path))

    assert changes(str(tmp_path), {}) == {"episodes/0.npz": None}
