import functools
import gzip
import http.server
import io
import subprocess
import tarfile
import threading

import numpy as np
import pytest

from forbes.data import download as downloads
from forbes.data.download import download, fetch_curves, git_blob_id
from forbes.data.strokes import fetch
from forbes.data.strokes.fetch import convert, fetch_dejong, read_archive, read_folder, wanted_files
from forbes.data.strokes.file import load_strokes, save_strokes, sha256_of_arrays
from forbes.errors import ForbesError

DIGITS = {"train": 2, "test": 1}
FILES = {  # what the upstream archive holds of so few digits
    "sequences/trainimg-0-inputdata.txt": b"5 9 0 0\n0 1 0 0\n0 0 1 0\n3 3 0 0\n0 0 1 1\n",
    "sequences/trainimg-0-targetdata.txt": b"not read\n",
    "sequences/trainimg-1-inputdata.txt": b"1 1 0 0\n0 0 1 1\n",
    "sequences/testimg-0-inputdata.txt": b"28 28 0 0\n-1 0 0 0\n0 0 1 1\n",
    "sequences/trainlabels.txt": b"4\n1\n",
    "sequences/testlabels.txt": b"7\n",
}


def entry(name, content=b"", kind=tarfile.REGTYPE, linkname=""):
    member = tarfile.TarInfo(name)
    member.size, member.type, member.linkname = len(content), kind, linkname
    return member, content


def pack(path, entries):
    with tarfile.open(path, "w:gz") as archive:
        for member, content in entries:
            archive.addfile(member, io.BytesIO(content))
    return path


@pytest.fixture
def tarball(tmp_path):
    return pack(
        tmp_path / "sequences.tar.gz",
        [entry("sequences", kind=tarfile.DIRTYPE)] + [entry(name, content) for name, content in FILES.items()],
    )


@pytest.fixture
def folder(tmp_path):
    for name, content in FILES.items():
        (tmp_path / "extracted" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "extracted" / name).write_bytes(content)
    return tmp_path / "extracted"


@pytest.fixture
def few_digits(tarball, monkeypatch):
    """Let the set be the three digits above."""
    splits = convert(read_archive(tarball, wanted_files(DIGITS)), DIGITS, tarball)
    monkeypatch.setattr(fetch, "DIGITS", DIGITS)
    monkeypatch.setattr(fetch, "DEJONG_BLOB", git_blob_id(tarball))
    monkeypatch.setattr("forbes.data.strokes.dejong.DEJONG_SHA256", sha256_of_arrays(splits))
    return splits


class Server(http.server.ThreadingHTTPServer):
    """Serves one file, with or without ranges, and may hang up early; remembers the ranges that were asked for."""

    content = b""
    ranges = True
    hang_up_after = None

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = []
        self.url = f"http://127.0.0.1:{self.server_address[1]}/sequences.tar.gz"


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server, range_ = self.server, self.headers["Range"]
        server.asked.append(range_)
        first = int(range_.removeprefix("bytes=").removesuffix("-")) if range_ and server.ranges else 0
        if self.path != "/sequences.tar.gz":
            self.send_error(404)
        elif first >= len(server.content):
            self.send_error(416)
        else:
            body = server.content[first:]
            self.send_response(206 if range_ and server.ranges else 200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body[: server.hang_up_after])

    def log_message(self, *args):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server() as server:
        server.content = np.random.default_rng(0).bytes(200_000)
        threading.Thread(target=functools.partial(server.serve_forever, poll_interval=0.01)).start()
        yield server
        server.shutdown()


def test_a_download_gives_the_servers_bytes(server, tmp_path):
    download(server.url, tmp_path / "new" / "file", "Do this.")

    assert (tmp_path / "new" / "file").read_bytes() == server.content
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file"]


def test_an_interrupted_download_goes_on_where_it_stopped(server, tmp_path):
    server.hang_up_after = 70_000
    with pytest.raises(ForbesError, match=r"interrupted after 70000 of 200000 bytes\. Run it again to resume"):
        download(server.url, tmp_path / "file", "Do this.")
    server.hang_up_after = None
    download(server.url, tmp_path / "file", "Do this.")

    assert (tmp_path / "file").read_bytes() == server.content
    assert server.asked == [None, "bytes=70000-"]


def test_a_server_without_ranges_sends_everything_again(server, tmp_path):
    server.ranges = False
    (tmp_path / "file.part").write_bytes(b"something else")

    download(server.url, tmp_path / "file", "Do this.")

    assert (tmp_path / "file").read_bytes() == server.content


def test_a_whole_part_is_not_downloaded_again(server, tmp_path):
    (tmp_path / "file.part").write_bytes(server.content)

    download(server.url, tmp_path / "file", "Do this.")

    assert (tmp_path / "file").read_bytes() == server.content


def test_a_download_larger_than_any_file_of_the_host_is_refused(server, tmp_path, monkeypatch):
    monkeypatch.setattr("forbes.data.download._DOWNLOAD_LIMIT", 100_000)

    with pytest.raises(ForbesError, match=r"sends more than 100000 bytes, expected a smaller file\. Do this\."):
        download(server.url, tmp_path / "file", "Do this.")


def test_a_file_the_server_does_not_have_is_named(server, tmp_path):
    with pytest.raises(ForbesError, match=r"/elsewhere: could not be downloaded \(HTTP Error 404: Not Found\)\. Do"):
        download(server.url.replace("sequences.tar.gz", "elsewhere"), tmp_path / "file", "Do this.")


def test_without_a_network_one_sentence_names_the_ways_out(tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetch, "DEJONG_URL", "http://127.0.0.1:1/sequences.tar.gz")

    with pytest.raises(
        ForbesError, match=r"could not be downloaded .* --from PATH, or use the bundled origin"
    ) as error:
        fetch_dejong(None, tmp_path / "dejong-strokes.npz")

    assert "\n" not in str(error.value)


def test_the_blob_id_is_gits(tmp_path):
    (tmp_path / "file").write_bytes(b"what git says\n" * 10_000)

    said = subprocess.run(["git", "hash-object", tmp_path / "file"], check=True, capture_output=True, text=True).stdout

    assert git_blob_id(tmp_path / "file") == said.strip()


def test_an_archive_and_its_folder_give_the_same_digits(tarball, folder):
    wanted = wanted_files(DIGITS)

    splits = convert(read_archive(tarball, wanted), DIGITS, tarball)

    assert splits["train"].points.tolist() == [[4, 8], [4, 9], [7, 12], [0, 0]]
    assert splits["train"].pen_up.tolist() == [False, True, True, True]
    assert splits["train"].offsets.tolist() == [0, 3, 4]
    assert splits["train"].labels.tolist() == [4, 1]
    assert splits["test"].points.tolist() == [[27, 27], [26, 27]]
    for source in (folder, folder / "sequences"):
        assert sha256_of_arrays(convert(read_folder(source, wanted), DIGITS, source)) == sha256_of_arrays(splits)


@pytest.mark.parametrize("source", ["download", "tarball", "folder", "npz"])
def test_every_source_is_verified_and_stored(source, few_digits, tarball, folder, server, tmp_path, monkeypatch):
    server.content = tarball.read_bytes()
    monkeypatch.setattr(fetch, "DEJONG_URL", server.url)
    save_strokes(tmp_path / "converted.npz", few_digits)
    path = {"download": None, "tarball": tarball, "folder": folder, "npz": tmp_path / "converted.npz"}[source]

    fetch_dejong(path, tmp_path / "store" / "dejong-strokes.npz")

    stored = load_strokes(tmp_path / "store" / "dejong-strokes.npz", "")
    assert sha256_of_arrays(stored) == sha256_of_arrays(few_digits)
    assert [path.name for path in (tmp_path / "store").iterdir()] == ["dejong-strokes.npz"]


def test_another_tarball_is_refused_before_it_is_read(tarball, tmp_path):
    with pytest.raises(ForbesError, match=r"the git blob id is .*, expected 33b359bd06060e7e98abffaf74470f0b7310d12b"):
        fetch_dejong(tarball, tmp_path / "store" / "dejong-strokes.npz")

    assert not (tmp_path / "store").exists()


def test_a_wrong_download_is_not_kept(few_digits, server, tmp_path, monkeypatch):
    monkeypatch.setattr(fetch, "DEJONG_URL", server.url)

    with pytest.raises(ForbesError, match="the git blob id is"):
        fetch_dejong(None, tmp_path / "store" / "dejong-strokes.npz")

    assert not list((tmp_path / "store").iterdir())


def test_a_converted_file_of_other_digits_is_refused(few_digits, tmp_path):
    few_digits["test"].points[0] = 0
    save_strokes(tmp_path / "other.npz", few_digits)

    with pytest.raises(ForbesError, match=r'other\.npz: array "test_points" has sha256'):
        fetch_dejong(tmp_path / "other.npz", tmp_path / "store" / "dejong-strokes.npz")


def test_a_path_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ForbesError, match="absent: no such file or folder"):
        fetch_dejong(tmp_path / "absent", tmp_path / "dejong-strokes.npz")


HOSTILE = [
    ([entry("../trainlabels.txt", b"1\n")], r"\.\./trainlabels\.txt is a link or points outside"),
    ([entry("sequences/../../trainlabels.txt", b"1\n")], "is a link or points outside"),
    ([entry("/sequences/trainlabels.txt", b"1\n")], "is a link or points outside"),
    ([entry("sequences/trainlabels.txt", kind=tarfile.SYMTYPE, linkname="/etc/passwd")], "is a link or points outside"),
    ([entry("sequences/other", kind=tarfile.LNKTYPE, linkname="/etc/passwd")], "is a link or points outside"),
    ([entry("sequences/other", kind=tarfile.FIFOTYPE)], "is a link or points outside"),
    ([entry("sequences/other", kind=tarfile.CHRTYPE)], "is a link or points outside"),
    ([entry("sequences/testlabels.txt", b"7\n")], "testlabels.txt occurs twice"),
    ([entry("./sequences//testlabels.txt", b"7\n")], "testlabels.txt occurs twice"),
]


@pytest.mark.parametrize(("entries", "message"), HOSTILE)
def test_a_hostile_archive_is_refused(tmp_path, entries, message):
    honest = [entry(name, content) for name, content in FILES.items()]
    path = pack(tmp_path / "hostile.tar.gz", honest + entries)

    with pytest.raises(ForbesError, match=message):
        convert(read_archive(path, wanted_files(DIGITS)), DIGITS, path)

    assert [path.name for path in tmp_path.iterdir()] == ["hostile.tar.gz"]


@pytest.mark.parametrize("name", ["sequences/other", "sequences/trainimg-0-inputdata.txt"])
def test_a_bomb_is_refused_before_it_fills_anything(tmp_path, monkeypatch, name):
    monkeypatch.setattr(fetch, "_ARCHIVE_LIMIT", 2**20)
    path = pack(tmp_path / "bomb.tar.gz", [entry(name, bytes(2**22))])
    assert path.stat().st_size < 2**14

    with pytest.raises(ForbesError, match=r"unpacks to more than 1048576 bytes|has more than 16384 bytes"):
        convert(read_archive(path, wanted_files(DIGITS)), DIGITS, path)


def test_a_digit_of_too_many_rows_is_refused_in_a_folder_too(folder):
    (folder / "sequences" / "trainimg-1-inputdata.txt").write_bytes(b"0 0 0 0\n" * 10_000)

    with pytest.raises(ForbesError, match=r"trainimg-1-inputdata\.txt has more than 16384 bytes"):
        convert(read_folder(folder, wanted_files(DIGITS)), DIGITS, folder)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_a_truncated_archive_is_refused(tarball, share):
    tarball.write_bytes(tarball.read_bytes()[: int(share * tarball.stat().st_size)])

    with pytest.raises(ForbesError, match="truncated or not a gzipped tar archive"):
        convert(read_archive(tarball, wanted_files(DIGITS)), DIGITS, tarball)


@pytest.mark.parametrize("content", [b"no archive", gzip.compress(b"no tar archive" * 100)], ids=["text", "gzip"])
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / "file").write_bytes(content)

    with pytest.raises(ForbesError, match="truncated or not a gzipped tar archive"):
        convert(read_archive(tmp_path / "file", wanted_files(DIGITS)), DIGITS, tmp_path / "file")


@pytest.mark.parametrize("name", ["trainimg-1-inputdata.txt", "testlabels.txt"])
def test_missing_files_are_named(tmp_path, folder, name):
    (folder / "sequences" / name).unlink()
    rest = [entry(full, content) for full, content in FILES.items() if not full.endswith(f"/{name}")]
    path = pack(tmp_path / "archive.tar.gz", rest)

    with pytest.raises(ForbesError, match=f"1 files such as {name} are missing"):
        convert(read_archive(path, wanted_files(DIGITS)), DIGITS, path)
    with pytest.raises(ForbesError, match=f"{name}: cannot be read"):
        convert(read_folder(folder, wanted_files(DIGITS)), DIGITS, folder)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (b"4\n", "expected one more than the 1 labels"),
        (b"4\nx\n", "a label is not a number"),
        (b"4\n12\n", "a label is 12"),
    ],
)
def test_wrong_labels_are_refused(folder, labels, message):
    (folder / "sequences" / "trainlabels.txt").write_bytes(labels)

    with pytest.raises(ForbesError, match=message):
        convert(read_folder(folder, wanted_files(DIGITS)), DIGITS, folder)


@pytest.fixture
def few_curves(server, tmp_path, monkeypatch):
    """Let the published curves be what the server has, and give a copy of them."""
    copy = tmp_path / "copy.json"
    copy.write_bytes(server.content)
    monkeypatch.setattr(downloads, "CURVES", (downloads.Curves("curves.json", server.url, git_blob_id(copy)),))
    return copy


@pytest.mark.parametrize("local", [False, True])
def test_curves_are_downloaded_or_copied_and_lie_there_whole(local, few_curves, tmp_path):
    stored = list(fetch_curves(few_curves if local else None, tmp_path / "store"))

    assert stored == [(tmp_path / "store" / "curves.json", True)]
    assert (tmp_path / "store" / "curves.json").read_bytes() == few_curves.read_bytes()
    assert [path.name for path in (tmp_path / "store").iterdir()] == ["curves.json"]


def test_only_curves_that_are_not_there_are_downloaded(few_curves, server, tmp_path, monkeypatch):
    missing = downloads.CURVES[0]._replace(name="others.json")
    few_curves.rename(tmp_path / "curves.json")
    monkeypatch.setattr(downloads, "CURVES", (downloads.CURVES[0]._replace(url="http://127.0.0.1:1"), missing))

    stored = list(fetch_curves(None, tmp_path))

    assert stored == [(tmp_path / "curves.json", False), (tmp_path / "others.json", True)]


@pytest.mark.parametrize("local", [False, True])
def test_other_curves_are_refused_and_those_that_were_there_stay(local, few_curves, tmp_path, monkeypatch):
    monkeypatch.setattr(downloads, "CURVES", (downloads.CURVES[0]._replace(blob="0" * 40),))
    (tmp_path / "curves.json").write_text("before")

    with pytest.raises(ForbesError, match=r"the git blob id is .*, expected 0{40}\. Give a local copy with"):
        list(fetch_curves(few_curves if local else None, tmp_path))

    assert (tmp_path / "curves.json").read_text() == "before"
    assert not (tmp_path / "curves.json.new").exists()


def test_a_copy_of_the_curves_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ForbesError, match=r"absent\.json: no such file\. Give a local copy with"):
        list(fetch_curves(tmp_path / "absent.json", tmp_path))
