"""Damaged files of every format, by the thousand: each read must give a scan or one line, soon and in little memory.

Run: ``python tests/fuzz/fuzz_formats.py --inputs 100000``. Every input is a function of its format, its number and the
seed, so that ``--only FORMAT --first NUMBER --inputs 1`` reads it again.
"""

import argparse
import multiprocessing
import random
import re
import resource
import struct
import sys
import tempfile
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from format_examples import NAMES, small_files
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import ScanFormat, load, read_scan
from lidargrit.scans.types import Scan

SECONDS_AT_MOST = 2.0  # for one input
MEGABYTES_AT_MOST = 300  # that one format's reader may take in all; inputs are below 2 MB
WELL = ("scan", "refused")  # all other outcomes are faults

NUMBERS = (
    b"-1",
    b"0",
    b"1",
    b"3",
    b"255",
    b"65536",
    b"4000000",
    b"4000001",
    b"2147483647",
    b"2147483648",
    b"4294967295",
)
NUMBERS += (b"18446744073709551616", b"9" * 400, b"1e9", b"nan", b"inf", b"", b"0x10", b"+7", b"1_0", b"3.5")
WORDS = (b"F", b"U", b"I", b"float", b"double", b"int", b"uchar", b"list", b"ascii", b"binary", b"binary_compressed")
WORDS += (
    b"vertex",
    b"element",
    b"property",
    b"end_header",
    b"DATA",
    b"x",
    b"<f8",
    b"|O",
    b">i2",
    b"<f2",
    b"True",
    b"#",
)
VALUES = (struct.pack("<f", float("nan")), struct.pack("<f", float("inf")), struct.pack(">f", float("nan")))
VALUES += (b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0" * 4, b"\0" * 16, b"\xff" * 8, struct.pack("<f", 1e38))

Files = list[tuple[str, str, bytes]]


def one_input(rng: random.Random, name: str, files: Files) -> tuple[str, bytes]:
    """Return a file's name and its damaged bytes."""
    own = [file for file in files if file[0] == name] or files
    _, file, data = rng.choice(own)
    kind = rng.random()
    if kind < 0.05:
        data = rng.randbytes(rng.choice((1, 12, 16, 20, 240, 4800, rng.randrange(5000))))
        return file, data if rng.random() < 0.5 else rng.choice(own)[2][: rng.randrange(64)] + data
    if kind < 0.08:  # a whole file of another format
        return file, rng.choice(files)[2]
    if kind < 0.35 and data[:2] == b"PK":
        return file, repacked(rng, data)
    if kind < 0.35 and data[:4] == b"\x89PNG":
        return file, with_new_sums(rng, data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(DAMAGES)(rng, data, files)
    return file, data


def truncated(rng: random.Random, data: bytes, files: Files) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def flipped(rng: random.Random, data: bytes, files: Files) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 2, 8))):
        if changed:
            changed[offset_in(rng, data)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwritten(rng: random.Random, data: bytes, files: Files) -> bytes:
    offset, value = offset_in(rng, data), rng.choice(VALUES)
    offset -= offset % rng.choice((1, 4))
    return data[:offset] + value + data[offset + len(value) :]


def renumbered(rng: random.Random, data: bytes, files: Files) -> bytes:
    return replaced(rng, data, rb"-?\d+", NUMBERS)


def reworded(rng: random.Random, data: bytes, files: Files) -> bytes:
    return replaced(rng, data, rb"[A-Za-z_<>|]+[0-9]?", WORDS)


def spliced(rng: random.Random, data: bytes, files: Files) -> bytes:
    other = rng.choice(files)[2]
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other)) :]


def moved(rng: random.Random, data: bytes, files: Files) -> bytes:
    """Cut a piece out, put a piece in twice, or put noise in."""
    start = offset_in(rng, data)
    piece = data[start : start + rng.choice((1, 3, 4, 16, 100))]
    middle = rng.choice((b"", piece + piece, rng.randbytes(4), piece * 50, b"\n", b" "))
    return data[:start] + middle + data[start + len(piece) :]


DAMAGES: tuple[Callable[[random.Random, bytes, Files], bytes], ...] = (
    truncated,
    flipped,
    overwritten,
    renumbered,
    reworded,
    spliced,
    moved,
)


def offset_in(rng: random.Random, data: bytes) -> int:
    """Return a place, mostly in the header."""
    return rng.randrange(max(1, min(len(data), rng.choice((64, 512, 512, len(data))))))


def replaced(rng: random.Random, data: bytes, pattern: bytes, by: tuple[bytes, ...]) -> bytes:
    found = list(re.finditer(pattern, data[:1000]))
    if not found:
        return data
    match, new = rng.choice(found), rng.choice(by)
    if rng.random() < 0.5:  # wherever it stands: a count that is written twice must agree with itself to come through
        return data[:1000].replace(match[0], new) + data[1000:]
    return data[: match.start()] + new + data[match.end() :]


def repacked(rng: random.Random, data: bytes) -> bytes:
    """Damage what is in an archive, and pack it with true sums, so that it comes through to the reader."""
    with BytesIO() as buffer:
        with zipfile.ZipFile(BytesIO(data)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
            for info in old.infolist():
                member = old.read(info)
                if rng.random() < 0.5:
                    member = rng.choice(DAMAGES[:5])(rng, member, [])
                name = rng.choice(("points.npy", "ring.npy", "label.npy", "x")) if rng.random() < 0.1 else info.filename
                with warnings.catch_warnings(action="ignore"):  # of names that come twice
                    new.writestr(name, member)
        return buffer.getvalue()


def with_new_sums(rng: random.Random, data: bytes) -> bytes:
    """Damage the chunks of a PNG and give them true sums."""
    out, offset = [data[:8]], 8
    while offset + 12 <= len(data):
        length = struct.unpack(">I", data[offset : offset + 4])[0]
        kind, body = data[offset + 4 : offset + 8], data[offset + 8 : offset + 8 + length]
        offset += 12 + length
        if rng.random() < 0.5:
            unpacked = zlib.decompress(body) if kind == b"IDAT" and rng.random() < 0.5 else body
            damaged = rng.choice((truncated, flipped, overwritten))(rng, unpacked, [])
            body = zlib.compress(damaged) if unpacked is not body else damaged
        out.append(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))
    return b"".join(out)


def outcome_of(form: type[ScanFormat], path: Path, rng: random.Random) -> str:
    """Read a file in all the ways that there are, and name what came of it."""
    try:
        if form.recognises(path) not in (True, False):
            return "recognises() says neither yes nor no"
    except BaseException as error:
        return f"recognises() raised {type(error).__name__}"
    bad_points = rng.choice(("refuse", "drop"))
    reads = (form.count, lambda p: form.read(p, 0, bad_points), lambda p: read_scan(p, bad_points=bad_points))
    results = []
    for read in reads:
        try:
            results.append("scan" if isinstance(read(path), Scan | int) else "no scan")
        except ScanError as error:
            results.append(fault_in(error, path) or "refused")
        except BaseException as error:
            results.append(f"raised {type(error).__name__}: {str(error)[:60]!r}")
    return next((result for result in results if result not in WELL), results[1])


def fault_in(error: ScanError, path: Path) -> str:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "took too much memory"
        cause = cause.__context__
    line = str(error)
    if path.stem not in line:
        return f"did not name the file: {line[:60]!r}"
    return "" if line.isprintable() and len(line) < 600 + 2 * len(str(path)) else f"no line: {line[:80]!r}"


def work(send: Connection, name: str, numbers: range, seed: int, files: Files, folder: Path) -> None:
    """Read inputs in a process of its own, and send what comes of each."""
    form = load(name)
    warnings.simplefilter("error")
    for _, file, data in (file for file in files if file[0] == name):  # what is loaded only when needed, now
        (folder / file).write_bytes(data)
        assert outcome_of(form, folder / file, random.Random(0)) == "scan", file
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    room = pages * resource.getpagesize() + MEGABYTES_AT_MOST * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (room, resource.RLIM_INFINITY))
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    send.send("ready")
    for number in numbers:
        rng = random.Random(f"{seed} {name} {number}")
        file, data = one_input(rng, name, files)
        (folder / file).write_bytes(data)
        result = outcome_of(form, folder / file, rng)
        grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb
        send.send("took too much memory" if grown_kb > MEGABYTES_AT_MOST * 1024 else result)


def outcomes(name: str, numbers: range, seed: int, files: Files, folder: Path) -> Iterator[str]:
    """Yield what comes of every input; after a fault, a hang or a crash the next goes to another worker."""
    fork = multiprocessing.get_context("fork")
    while numbers:
        receive, send = fork.Pipe(duplex=False)
        worker = fork.Process(target=work, args=(send, name, numbers, seed, files, folder), daemon=True)
        worker.start()
        send.close()
        if not receive.poll(60) or receive.recv() != "ready":
            raise RuntimeError(f"no worker for {name}")
        result = "scan"
        while numbers and result in WELL:
            try:
                result = receive.recv() if receive.poll(SECONDS_AT_MOST) else "hung"
            except EOFError:
                result = "killed its process"
            numbers = numbers[1:]
            yield result
        worker.kill()
        worker.join()
        receive.close()


def real_files(real: Path, folder: Path) -> Files:
    """Return a recording, which we cannot write, and a packed table; what belongs to them is put into the folder."""
    found: Files = []
    for name in ("ouster_pcap", "argoverse_feather"):
        paths = [path for path in sorted(real.rglob("*")) if path.name.endswith(load(name).suffixes)]
        for path in paths[:1]:
            found.append((name, path.name, path.read_bytes()))
            for beside in path.parent.glob(f"{path.stem}.json"):
                (folder / beside.name).write_bytes(beside.read_bytes())
    return found


def fuzz(inputs: int, seed: int = 0, only: str = "", first: int = 0, real: Path | None = None) -> dict[str, Counter]:
    """Read ``inputs`` damaged files, shared out among the formats, and count what came of them."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        folder = Path(name)
        files = small_files(folder) + (real_files(real, folder) if real else [])
        names = [one for one in NAMES if any(file[0] == one for file in files) and only in ("", one)]
        table: dict[str, Counter] = {one: Counter() for one in names}
        for rank, one in enumerate(names):
            numbers = range(first, first + inputs // len(names) + (rank < inputs % len(names)))
            for number, outcome in zip(numbers, outcomes(one, numbers, seed, files, folder), strict=True):
                table[one][outcome] += 1
                if outcome not in WELL:
                    print(f"{one} number {number} of seed {seed}: {outcome}", flush=True)
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", choices=["", *NAMES])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--real", type=Path, help="a folder of real scans, for what we cannot write")
    arguments = parser.parse_args()
    table = fuzz(arguments.inputs, arguments.seed, arguments.only, arguments.first, arguments.real)
    print(f"{'format':20}{'scan':>9}{'refused':>9}{'faults':>9}")
    for name, counts in table.items():
        faults = counts.total() - sum(counts[one] for one in WELL)
        print(f"{name:20}{counts['scan']:9,}{counts['refused']:9,}{faults:9,}")
    return int(any(set(counts) - set(WELL) for counts in table.values()))


if __name__ == "__main__":
    sys.exit(main())
