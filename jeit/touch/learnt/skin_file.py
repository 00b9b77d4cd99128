"""Read and write learnt skins as files in the format of the package skops, which stores arrays and scikit-learn
estimators without pickle.

A file is a ZIP archive. Equal content gives equal bytes: the objects, which skops numbers by their memory addresses,
are renumbered in order of appearance, and the time of writing is not stored. A checksum detects files that
were changed after jeit wrote them. It is computed without a secret key, so it does not prove who wrote the file.
"""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

from jeit.arguments import describe, names_text
from jeit.arguments.extras import require_extra
from jeit.files import atomically_written_file, check_archive, error_text
from jeit.touch.kohonen.placed_map import PlacedMap
from jeit.touch.kohonen.self_organising_map import SelfOrganisingMap
from jeit.touch.learnt.array_models import Forest, NearestNeighbours, SupportVectorMachine
from jeit.touch.learnt.channels import Channels, Neighbourhood
from jeit.touch.learnt.features import ContactFeatures, Features, ImageFeatures, ImageReconstruction, WhitenedChanges
from jeit.touch.learnt.labels import LearntKeys, LearntLabels, StandardisedFeatures
from jeit.touch.learnt.learnt_skin import LearntSkin
from jeit.touch.learnt.methods import GaussianProcess, LinearEnsemble, QuadraticDiscriminant
from jeit.touch.learnt.neural_networks import Network, TemporalNetwork
from jeit.touch.learnt.regression import DeviationModel, LearntNumbers

_SCHEMA_FILE = "schema.json"
# Matches the number of an object in the schema of a skops file, also where the number is part of a file name.
_OBJECT_NUMBER = re.compile(r'("__id__": |"file": ")(\d+)')


def write_with_checksum(content: Any, file: BinaryIO) -> None:
    """Write arrays and estimators, or lists and dictionaries of them, to a ZIP archive with a checksum."""
    from skops.io import dumps

    with zipfile.ZipFile(io.BytesIO(dumps(content))) as archive:
        archive_files = {file_name: archive.read(file_name) for file_name in archive.namelist()}
    new_numbers: dict[str, str] = {}

    def renumber(number_match: re.Match[str]) -> str:
        return number_match[1] + new_numbers.setdefault(number_match[2], str(len(new_numbers)))

    schema = _OBJECT_NUMBER.sub(renumber, archive_files.pop(_SCHEMA_FILE).decode())
    renamed_members = {
        f"{new_numbers[Path(file_name).stem]}.npy": file_content for file_name, file_content in archive_files.items()
    }
    renamed_members = {_SCHEMA_FILE: schema.encode(), **dict(sorted(renamed_members.items()))}
    with zipfile.ZipFile(file, "w") as archive:
        for file_name, file_content in renamed_members.items():
            archive.writestr(zipfile.ZipInfo(file_name), file_content)
        archive.comment = _archive_checksum(renamed_members)


def verify_checksum(path: Path) -> None:
    """Verify the checksum of an archive. Raises `ValueError` if the archive was changed after it was written."""
    with zipfile.ZipFile(path) as archive:
        archive_files = {file_name: archive.read(file_name) for file_name in archive.namelist()}
        if archive.comment != _archive_checksum(archive_files):
            raise ValueError("it was changed since it was written, or an earlier jeit wrote it")


def _archive_checksum(archive_files: dict[str, bytes]) -> bytes:
    """Compute the checksum of the names and contents of the files in an archive."""
    content_hash = hashlib.sha256()
    for file_name in sorted(archive_files):
        content_hash.update(f"{file_name} {len(archive_files[file_name])}\n".encode() + archive_files[file_name])
    return b"jeit " + content_hash.hexdigest().encode()


_FILE_KIND, _FILE_VERSION = "a jeit learnt skin", 2
# Names of fields in files that jeit 0.2 wrote, and the present names of these fields.
_RENAMED_FIELDS = {"unforetold": "unpredicted"}
# Classes of the objects that a file can store, by their names in the file.
_STORED_CLASSES: dict[str, type] = {
    "Channels": Channels,
    "Contacts": ContactFeatures,
    "Features": Features,
    "Forest": Forest,
    "GaussianProcess": GaussianProcess,
    "Imaged": ImageReconstruction,
    "Images": ImageFeatures,
    "LearntKeys": LearntKeys,
    "LearntLabels": LearntLabels,
    "LearntNumbers": LearntNumbers,
    "LinearEnsemble": LinearEnsemble,
    "Machine": SupportVectorMachine,
    "Nearest": NearestNeighbours,
    "Neighbourhood": Neighbourhood,
    "Network": Network,
    "PlacedMap": PlacedMap,
    "QuadraticDiscriminant": QuadraticDiscriminant,
    "SelfOrganisingMap": SelfOrganisingMap,
    "Spread": DeviationModel,
    "Standardised": StandardisedFeatures,
    "TemporalNetwork": TemporalNetwork,
    "Whitened": WhitenedChanges,
}
_STORED_NAMES = {stored: name for name, stored in _STORED_CLASSES.items()}


def write_skin(skin: LearntSkin, path: str | Path) -> None:
    """Write a learnt skin to one file, without its field `standing` (accuracy on held-out presses).

    **Arguments:**

    - `skin`: the learnt skin.
    - `path`: path of the file.

    Raises `ValueError` if `path` is a folder.

    **Example:**

    ```python
    write_skin(learnt, "skin.skops")
    learnt = read_skin("skin.skops")
    ```
    """
    fields_by_name = {
        stored_field.name: getattr(skin, stored_field.name)
        for stored_field in fields(skin)
        if stored_field.name != "standing"
    }
    write_fields(path, _FILE_KIND, _FILE_VERSION, fields_by_name, "skin.skops")


def read_skin(path: str | Path) -> LearntSkin:
    """Read a learnt skin from a file, or from the folder that `jeit touch fit` wrote.

    Nothing in the file is executed: the file may contain only numbers and estimators of scikit-learn.

    **Arguments:**

    - `path`: path of the file or folder.

    Raises `FileNotFoundError` if the path does not exist, and `ValueError` if the file does not describe a learnt skin
    or contains objects other than numbers and estimators.

    **Example:**

    ```python
    write_skin(learnt, "skin.skops")
    learnt = read_skin("skin.skops")
    ```
    """
    path = Path(path)
    if path.is_dir():
        path = path / "skin.skops"
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file; `jeit touch fit` makes one.")
    return read_fields(path, _FILE_KIND, _FILE_VERSION, "learnt skin", lambda skin_fields: LearntSkin(**skin_fields))


def write_fields(path: str | Path, kind: str, version: int, fields_by_name: dict[str, Any], example: str) -> None:
    """Write the fields of an object to one file; the fields may be arrays, estimators, and objects of jeit's classes.

    `fields_by_name`: the fields, by name; `kind` and `version` identify the type of file; `example`: a file name that
    the error message suggests. Raises `ValueError` if `path` is a folder.
    """
    require_extra("learn", "a file of a learnt skin")
    if Path(path).is_dir():
        raise ValueError(f"'{path}' is a folder; give a file, such as {Path(path) / example}.")
    with atomically_written_file(path) as file:
        write_with_checksum({"kind": kind, "version": version, "skin": _to_dictionaries(fields_by_name)}, file)


def read_fields(path: Path, kind: str, version: int, description: str, make: Callable[[dict[str, Any]], Any]) -> Any:
    """Read a file that `write_fields` wrote, and return `make(fields)`, where `fields` are the written fields, by name.

    Nothing in the file is executed. `description`: the expected content of the file, as error messages name it. Raises
    `ValueError` if the file is of another `kind` or contains anything but arrays, estimators and objects of jeit's
    classes.
    """
    require_extra("learn", "a file of a learnt skin")
    from skops.io import get_untrusted_types, load

    try:
        check_archive(path)
        untrusted_types = sorted(get_untrusted_types(file=path))
        if untrusted_types:
            raise ValueError(f"it holds {names_text(untrusted_types, max_names=3)}, which no {description} does")
        content = load(path, trusted=[])
        if not isinstance(content, dict) or content.get("kind") != kind:
            raise ValueError("it is of another kind")
        if content["version"] != version:
            raise ValueError(f"it is of version {describe(content['version'])}, and this jeit reads {version}")
        verify_checksum(path)
        fields_by_name: Any = _from_dictionaries(content["skin"])
        return make(fields_by_name)
    except Exception as error:  # any exception: the file may create objects of many packages
        raise ValueError(
            f"'{path}' is not a {description} that can be read ({error_text(error)}); fit it again."
        ) from None


def _to_dictionaries(stored_value):
    """Convert objects of jeit's classes (those in `_STORED_CLASSES`) to dictionaries of their fields, recursively."""
    if type(stored_value) in _STORED_NAMES:
        return {
            "jeit": _STORED_NAMES[type(stored_value)],
            **{
                stored_item.name: _to_dictionaries(getattr(stored_value, stored_item.name))
                for stored_item in fields(stored_value)
            },
        }
    if isinstance(stored_value, dict):
        return {stored_key: _to_dictionaries(stored_item) for stored_key, stored_item in stored_value.items()}
    if isinstance(stored_value, list | tuple):
        return [_to_dictionaries(stored_item) for stored_item in stored_value]
    return stored_value


def _from_dictionaries(stored_value):
    """Convert dictionaries of fields, which `_to_dictionaries` returned, back to objects of jeit's classes,
    recursively."""
    if isinstance(stored_value, dict):
        restored_values = {
            _RENAMED_FIELDS.get(stored_key, stored_key): _from_dictionaries(stored_item)
            for stored_key, stored_item in stored_value.items()
            if stored_key != "jeit"
        }
        return _STORED_CLASSES[stored_value["jeit"]](**restored_values) if "jeit" in stored_value else restored_values
    return (
        [_from_dictionaries(stored_item) for stored_item in stored_value]
        if isinstance(stored_value, list)
        else stored_value
    )
