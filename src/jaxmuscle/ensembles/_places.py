"""Where a store lies: a folder, or the URL of an object store; its keys and their bytes."""

import contextlib
import errno
import glob
import itertools
import os
import re
import shutil
import tempfile
import uuid
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx

from jaxmuscle._common.errors import StoreError
from jaxmuscle._common.files import to_disk

from ._locks import WHOLE, Holder, busy, left, locked, taken_over

ROOT = "zarr.json"  # a store is there once it has this key
PROGRESS = "progress"
CLAIM = f"{PROGRESS}/settings.json"
UNFINISHED = ".partial"  # how zarr calls files that it is writing, too
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)


class AbstractPlace(eqx.Module):
    """Where a store lies. Its keys, such as `progress/a.json`, hold bytes; every key is written
    whole or not at all."""

    name: eqx.AbstractVar[str]

    @abstractmethod
    def opened(self) -> Any:
        """What zarr and xarray open."""

    @abstractmethod
    def exists(self) -> bool:
        """Whether a store, or something else, is there."""

    @abstractmethod
    def read(self, key: str) -> bytes | None:
        """The bytes of a key, None if there is none."""

    @abstractmethod
    def write(self, entries: Mapping[str, bytes]) -> None:
        """Set or replace the bytes of keys, which are on disk afterwards."""

    @abstractmethod
    def settle(self, keys: Iterable[str]) -> None:
        """Wait until these keys, which zarr wrote, are on disk."""

    @abstractmethod
    def progress(self) -> list[str]:
        """The keys below `progress/`, sorted."""

    @abstractmethod
    def remove(self, *keys: str) -> None:
        """Remove these keys."""

    @abstractmethod
    def forget(self) -> None:
        """Remove all keys below `progress/`, and what processes that were killed left here. For the
        only writer."""

    @abstractmethod
    def locked(self, role: str) -> contextlib.AbstractContextManager[None]:
        """Be a writer of the store, whether it is there or not; see `_locks.locked`."""

    @abstractmethod
    def claim(self, settings: str) -> str:
        """The settings of whoever was the first to begin a store here: these, or another's."""

    @abstractmethod
    def building(self) -> contextlib.AbstractContextManager[Path]:
        """A temporary folder in which a store is built before it is put here."""

    @abstractmethod
    def put(self, built: Path) -> bool:
        """The store that was built, unless another is there already; whether it was put."""

    @abstractmethod
    def clear(self) -> None:
        """Remove the store. An interruption leaves something that is not taken for a store."""


class Folder(AbstractPlace):
    """A folder. A new store takes its name in one step, so the first one wins."""

    name: str
    path: Path

    def opened(self) -> Path:
        return self.path

    def exists(self) -> bool:
        return self.path.exists() or self.path.is_symlink()

    def read(self, key: str) -> bytes | None:
        try:
            return (self.path / key).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, entries: Mapping[str, bytes]) -> None:
        ready: dict[Path, Path] = {}
        try:
            for key, data in entries.items():
                file = self.path / key
                file.parent.mkdir(parents=True, exist_ok=True)
                ready[file] = file.with_name(f"{file.name}.{uuid.uuid4().hex}{UNFINISHED}")
                ready[file].write_bytes(data)
            to_disk(ready.values())
            for file, unfinished in ready.items():
                os.replace(unfinished, file)
        finally:
            for unfinished in ready.values():
                unfinished.unlink(missing_ok=True)
        to_disk(folder for file in ready for folder in self._above(file))

    def settle(self, keys: Iterable[str]) -> None:
        files = [self.path / key for key in keys]
        to_disk([*files, *(folder for file in files for folder in self._above(file))])

    def _above(self, file: Path) -> Iterator[Path]:
        """Folders of a file, up to the store's."""
        return itertools.takewhile(lambda folder: folder != self.path.parent, file.parents)

    def progress(self) -> list[str]:
        return sorted(
            f"{PROGRESS}/{file.name}"
            for file in (self.path / PROGRESS).glob("*")
            if file.suffix != UNFINISHED
        )

    def remove(self, *keys: str) -> None:
        for key in keys:
            (self.path / key).unlink(missing_ok=True)

    def forget(self) -> None:
        if (self.path / PROGRESS).exists():
            shutil.rmtree(self.path / PROGRESS)
        for unfinished in self.path.rglob(f"*{UNFINISHED}"):
            unfinished.unlink(missing_ok=True)
        for built in glob.glob(f"{glob.escape(str(self._built))}*"):
            shutil.rmtree(built)

    @property
    def _built(self) -> Path:
        return self.path.parent / f".{self.path.name}.new-"

    def locked(self, role: str) -> contextlib.AbstractContextManager[None]:
        return locked(self.path, self.name, role)

    def claim(self, settings: str) -> str:
        return settings

    @contextlib.contextmanager
    def building(self) -> Iterator[Path]:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=self._built.name, dir=self.path.parent))
        try:
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def put(self, built: Path) -> bool:
        built.chmod(0o755)
        to_disk([built, *built.rglob("*")])
        try:
            os.rename(built, self.path)
        except OSError as error:
            if error.errno not in TAKEN:
                raise
            return False
        to_disk([self.path.parent])
        return True

    def clear(self) -> None:
        aside = Path(tempfile.mkdtemp(prefix=self._built.name, dir=self.path.parent))
        os.rename(self.path, aside / "old")  # in one step: what is half removed has another name
        shutil.rmtree(aside)


class Bucket(AbstractPlace):
    """A prefix in an object store, which has no renaming: the root key of a store is written last.

    Who begins says the settings first, in a key that is created once only where the object store
    can do that.
    """

    name: str
    files: Any
    path: str

    def opened(self) -> Any:
        from zarr.storage import FsspecStore

        return FsspecStore.from_mapper(self.files.get_mapper(self.path))

    def exists(self) -> bool:
        try:
            self.files.invalidate_cache()
            # In this order: others may begin meanwhile, with the claim, or complete, with the root
            # before the claim goes.
            anything, claim, root = (
                self.files.exists(path) for path in (self.path, self._full(CLAIM), self._full(ROOT))
            )
            return root or (anything and not claim)
        except Exception as error:  # every object store fails in its own way
            raise StoreError(
                f"{self.name}: cannot be reached ({type(error).__name__}: {error}); check the URL,"
                " the network and the credentials"
            ) from error

    def read(self, key: str) -> bytes | None:
        return self._cat(self._full(key))

    def write(self, entries: Mapping[str, bytes]) -> None:
        for key, data in entries.items():
            self.files.pipe_file(self._full(key), data)

    def settle(self, keys: Iterable[str]) -> None:
        pass  # what an object store has accepted, it keeps

    def progress(self) -> list[str]:
        return [f"{PROGRESS}/{name}" for name in self._names(self._full(PROGRESS))]

    def _names(self, folder: str) -> list[str]:
        self.files.invalidate_cache()
        try:
            return sorted(name.rsplit("/", 1)[-1] for name in self.files.ls(folder, detail=False))
        except FileNotFoundError:
            return []

    def remove(self, *keys: str) -> None:
        for key in keys:
            self._drop(self._full(key))

    def _drop(self, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.files.rm_file(path)

    def forget(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.files.rm(self._full(PROGRESS), recursive=True)

    def claim(self, settings: str) -> str:
        self._create(self._full(CLAIM), settings.encode())
        return (self.read(CLAIM) or b"").decode()

    def building(self) -> contextlib.AbstractContextManager[Path]:
        return _temporary()

    def put(self, built: Path) -> bool:
        for file in sorted(
            file for file in built.rglob("*") if file.is_file() and file != built / ROOT
        ):
            self.write({file.relative_to(built).as_posix(): file.read_bytes()})
        return self._create(self._full(ROOT), (built / ROOT).read_bytes())

    def clear(self) -> None:
        self.remove(ROOT)
        self.files.rm(self.path, recursive=True)

    @contextlib.contextmanager
    def locked(self, role: str) -> Iterator[None]:
        """A key beside the store says who writes. Without the system's help, a lock that was left
        is told by its process."""
        folder = f"{self.path.rstrip('/')}.lock"
        name = role or "whole"
        mine, holder = f"{folder}/{name}", Holder.here().to_bytes()
        self._require_free(mine, patient=role.startswith("part"))
        if not self._create(mine, holder):
            raise busy(self.name, Holder.of(self._cat(mine)) or "another process")
        try:
            others = {WHOLE: self._names(folder), "part": ["whole"]}.get(role.partition("-")[0], [])
            for other in others:
                if other != name:
                    self._require_free(f"{folder}/{other}", patient=False)
            yield
        finally:
            if self._cat(mine) == holder:
                self._drop(mine)

    def _require_free(self, lock: str, *, patient: bool) -> None:
        who = Holder.of(self._cat(lock))
        if who is None:
            return
        if not who.dead and not (patient and not who.local):
            raise (
                busy(self.name, who)
                if who.local
                else left(self.name, who, f"remove the key {lock}")
            )
        taken_over(self.name, who)
        self._drop(lock)

    def _cat(self, path: str) -> bytes | None:
        try:
            return self.files.cat_file(path)
        except FileNotFoundError:
            return None

    def _full(self, key: str) -> str:
        return f"{self.path.rstrip('/')}/{key}"

    def _create(self, path: str, data: bytes) -> bool:
        """Set a key unless it is there, as far as the object store can do that."""
        try:
            self.files.pipe_file(path, data, mode="create")
        except FileExistsError:
            return False
        return True


@contextlib.contextmanager
def _temporary() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def place_of(path: str | Path) -> AbstractPlace:
    """The place that a path or a URL names; `file://` names a folder.

    **Raises:** `StoreError` for a URL without fsspec (extra `url`), or that fsspec does not know.
    """
    text = str(path)
    if text.startswith("file://") or not re.match(r"[\w.+:-]+://", text):
        folder = Path(text.removeprefix("file://"))
        return Folder(str(folder), folder)
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise StoreError(f"{text}: a URL needs fsspec: pip install fsspec") from error
    try:
        # fsspec's own local files, with which tests play an object store, make no folders unless
        # they are told to.
        files, inside = url_to_fs(
            text, **({"auto_mkdir": True} if text.startswith("local://") else {})
        )
    except (ImportError, ValueError) as error:
        raise StoreError(f"{text}: {error}") from error
    return Bucket(text, files, inside)
