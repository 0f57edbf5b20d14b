"""Where a store lies: a folder, or the URL of an object store; its keys and their bytes."""

import contextlib
import errno
import os
import re
import shutil
import tempfile
from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx

from jaxmuscle._common.errors import StoreError
from jaxmuscle._common.files import replacing

ROOT = "zarr.json"  # a store is there once it has this key
PROGRESS = "progress"
CLAIM = f"{PROGRESS}/settings.json"
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)


class AbstractPlace(eqx.Module):
    """Where a store lies. Its keys, such as `progress/a.json`, hold bytes; every key is written whole or not at all."""

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
    def write(self, key: str, data: bytes) -> None:
        """Set or replace the bytes of a key."""

    @abstractmethod
    def progress(self) -> list[str]:
        """The keys below `progress/`, sorted."""

    @abstractmethod
    def remove(self, *keys: str) -> None:
        """Remove these keys."""

    @abstractmethod
    def forget(self) -> None:
        """Remove all keys below `progress/`."""

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

    def write(self, key: str, data: bytes) -> None:
        with replacing(self.path / key) as temporary:
            temporary.write_bytes(data)

    def progress(self) -> list[str]:
        return sorted(f"{PROGRESS}/{file.name}" for file in (self.path / PROGRESS).glob("[!.]*"))

    def remove(self, *keys: str) -> None:
        for key in keys:
            (self.path / key).unlink(missing_ok=True)

    def forget(self) -> None:
        shutil.rmtree(self.path / PROGRESS, ignore_errors=True)  # a part that is repeated may be writing there

    def claim(self, settings: str) -> str:
        return settings

    @contextlib.contextmanager
    def building(self) -> Iterator[Path]:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{self.path.name}-", dir=self.path.parent))
        try:
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def put(self, built: Path) -> bool:
        built.chmod(0o755)
        try:
            os.rename(built, self.path)
        except OSError as error:
            if error.errno not in TAKEN:
                raise
            return False
        return True

    def clear(self) -> None:
        shutil.rmtree(self.path)


class Bucket(AbstractPlace):
    """A prefix in an object store, which has no renaming: the root key of a store is written last.

    Who begins says the settings first, in a key that is created once only where the object store can do that.
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
            # In this order: others may begin meanwhile, with the claim, or complete, with the root before the claim goes.
            anything, claim, root = (self.files.exists(path) for path in (self.path, self._full(CLAIM), self._full(ROOT)))
            return root or (anything and not claim)
        except Exception as error:  # every object store fails in its own way
            raise StoreError(f"{self.name}: cannot be reached ({type(error).__name__}: {error}); check the URL, the network "
                             "and the credentials") from error  # fmt: skip

    def read(self, key: str) -> bytes | None:
        try:
            return self.files.cat_file(self._full(key))
        except FileNotFoundError:
            return None

    def write(self, key: str, data: bytes) -> None:
        self.files.pipe_file(self._full(key), data)

    def progress(self) -> list[str]:
        self.files.invalidate_cache()
        try:
            found = self.files.ls(self._full(PROGRESS), detail=False)
        except FileNotFoundError:
            return []
        return sorted(f"{PROGRESS}/{name.rsplit('/', 1)[-1]}" for name in found)

    def remove(self, *keys: str) -> None:
        for key in keys:
            with contextlib.suppress(FileNotFoundError):
                self.files.rm_file(self._full(key))

    def forget(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.files.rm(self._full(PROGRESS), recursive=True)

    def claim(self, settings: str) -> str:
        self._create(CLAIM, settings.encode())
        return (self.read(CLAIM) or b"").decode()

    def building(self) -> contextlib.AbstractContextManager[Path]:
        return _temporary()

    def put(self, built: Path) -> bool:
        for file in sorted(file for file in built.rglob("*") if file.is_file() and file != built / ROOT):
            self.write(file.relative_to(built).as_posix(), file.read_bytes())
        return self._create(ROOT, (built / ROOT).read_bytes())

    def clear(self) -> None:
        self.remove(ROOT)
        self.files.rm(self.path, recursive=True)

    def _full(self, key: str) -> str:
        return f"{self.path.rstrip('/')}/{key}"

    def _create(self, key: str, data: bytes) -> bool:
        try:
            self.files.pipe_file(self._full(key), data, mode="create")
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
        raise StoreError(f"{text}: a URL needs fsspec: pip install 'jaxmuscle[url]'") from error
    try:
        # fsspec's own local files, with which tests play an object store, make no folders unless they are told to.
        files, inside = url_to_fs(text, **({"auto_mkdir": True} if text.startswith("local://") else {}))
    except (ImportError, ValueError) as error:
        raise StoreError(f"{text}: {error}") from error
    return Bucket(text, files, inside)
