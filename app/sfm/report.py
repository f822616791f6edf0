"""What structure-from-motion did: how many images registered, by which strategy, and why others did not."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

import pycolmap

from app.capture.inventory import Inventory

_FEW_FEATURES = 50
_MIN_INLIERS = 15
"""COLMAP's least number of verified matches for a pair to count."""


class Reason(StrEnum):
    """Why an image did not register."""

    FEW_FEATURES = "few features"
    FEW_MATCHES = "few matches"
    ISOLATED = "isolated: matches only images outside the largest model"
    OTHER_MODEL = "in another component"
    FILTERED = "filtered: matches the model, but no pose fits"
    NO_POSE = "no pose given"


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One strategy tried."""

    strategy: str
    registered: int
    steady: int
    """Registered images of cameras that keep their places relative to each other."""
    observations: int
    components: tuple[int, ...]
    """Images per model, largest first."""
    with_rig: bool
    """The rig fits, and the largest model was adjusted with it."""
    agrees: bool
    """Images are where the best strategy before had them."""

    @property
    def is_torn(self) -> bool:
        """Cameras of a rig don't keep their places relative to each other."""
        return self.steady < self.registered

    @property
    def rank(self) -> tuple[int, int, int]:
        """What makes one attempt better than another."""
        return self.steady, self.registered, self.observations

    def describe(self, num_images: int) -> str:
        """One line."""
        torn = f", {self.registered - self.steady} of them torn off" if self.is_torn else ""
        elsewhere = "" if self.agrees else ", elsewhere than before"
        return f"{self.strategy} registers {self.registered} of {num_images} images{torn}{elsewhere}"


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """One camera folder."""

    name: str
    registered: int
    images: int
    model: str
    params: tuple[float, ...]
    """COLMAP's, pixels."""


@dataclass(frozen=True, kw_only=True)
class SfmReport:
    """What `run_sfm` or `import_model` made."""

    used: str
    """Strategy, `known-poses` or `imported`."""
    registered: int
    images: int
    points: int
    observations: int
    mean_reprojection_error_px: float
    cameras: tuple[CameraReport, ...]
    attempts: tuple[Attempt, ...]
    components: tuple[int, ...]
    """Images per model kept, largest first."""
    pairs_matched: int
    unregistered: dict[str, str]
    """Image name to reason."""

    def write(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> SfmReport:
        """Read what `write` wrote."""
        data = json.loads(path.read_text(encoding="utf-8"))
        data["cameras"] = tuple(
            CameraReport(**camera | {"params": tuple(camera["params"])}) for camera in data["cameras"]
        )
        data["attempts"] = tuple(
            Attempt(**attempt | {"components": tuple(attempt["components"])}) for attempt in data["attempts"]
        )
        data["components"] = tuple(data["components"])
        return cls(**data)

    def describe(self) -> str:
        """One line, then a table of cameras, then why images are missing."""
        others = f", {len(self.components) - 1} smaller models beside it" if len(self.components) > 1 else ""
        lines = [
            f"sfm: {self.registered} of {self.images} images registered by {self.used}, {self.points} points, "
            f"{self.mean_reprojection_error_px:.2f} px{others}"
        ]
        width = max([len(camera.name) for camera in self.cameras] + [6])
        if len(self.cameras) > 1:
            lines.append(f"  {'camera':<{width}}  registered  images")
            lines += [f"  {c.name:<{width}}  {c.registered:>10}  {c.images:>6}" for c in self.cameras]
        reasons: dict[str, list[str]] = {}
        for name, reason in self.unregistered.items():
            reasons.setdefault(reason, []).append(name)
        for reason, names in reasons.items():
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            lines.append(f"  not registered, {reason}: {', '.join(names[:3])}{more}")
        return "\n".join(lines)


def make_report(
    model: pycolmap.Reconstruction,
    inventory: Inventory,
    *,
    used: str,
    attempts: Sequence[Attempt] = (),
    components: Sequence[Sequence[str]] = (),
    database_path: Path | None = None,
    given_poses: Sequence[str] | None = None,
) -> SfmReport:
    """Describe a model.

    Args:
        model: the largest component.
        inventory: all images.
        used: what made it.
        attempts: strategies tried.
        components: image names of each model kept, largest first.
        database_path: features and matches, for the reasons.
        given_poses: image names with known poses, where poses were given.
    """
    registered = {model.image(image_id).name: model.image(image_id) for image_id in model.reg_image_ids()}
    missing = sorted(image.name for image in inventory.images if image.name not in registered)
    pairs: dict[str, set[str]] = {}
    features: dict[str, int] = {}
    num_pairs = 0
    if database_path is not None:
        with pycolmap.Database.open(database_path) as database:
            num_pairs, features, pairs = _matches(database)
    elsewhere = {name for names in components[1:] for name in names}
    unregistered = {name: str(_reason(name, registered, elsewhere, features, pairs, given_poses)) for name in missing}
    cameras = []
    for entry in inventory.cameras:
        names = [frame.images[entry.name] for frame in inventory.frames if entry.name in frame.images]
        camera = next((registered[name].camera for name in names if name in registered), None)
        cameras.append(
            CameraReport(
                name=entry.name,
                registered=sum(name in registered for name in names),
                images=len(names),
                model=camera.model_name if camera is not None else "",
                params=tuple(float(value) for value in camera.params) if camera is not None else (),
            )
        )
    return SfmReport(
        used=used,
        registered=len(registered),
        images=len(inventory.images),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        mean_reprojection_error_px=round(model.compute_mean_reprojection_error(), 4) if model.num_points3D() else 0.0,
        cameras=tuple(cameras),
        attempts=tuple(attempts),
        components=tuple(len(names) for names in components) or (len(registered),),
        pairs_matched=num_pairs,
        unregistered=unregistered,
    )


def _matches(database: pycolmap.Database) -> tuple[int, dict[str, int], dict[str, set[str]]]:
    """Number of verified pairs, features by image name, and by image name the images it has verified matches with."""
    names = {image.image_id: image.name for image in database.read_all_images()}
    features = {name: database.num_keypoints_for_image(image_id) for image_id, name in names.items()}
    partners: dict[str, set[str]] = {name: set() for name in names.values()}
    num_pairs = 0
    for pair_id, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
        if inliers >= _MIN_INLIERS:
            first, second = (names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
            partners[first].add(second)
            partners[second].add(first)
            num_pairs += 1
    return num_pairs, features, partners


def _reason(
    name: str,
    registered: Mapping[str, object],
    elsewhere: set[str],
    features: Mapping[str, int],
    partners: Mapping[str, set[str]],
    given_poses: Sequence[str] | None,
) -> Reason:
    if given_poses is not None and name not in given_poses:
        return Reason.NO_POSE
    if name in elsewhere:
        return Reason.OTHER_MODEL
    if features.get(name, _FEW_FEATURES) < _FEW_FEATURES:
        return Reason.FEW_FEATURES
    if not partners.get(name):
        return Reason.FEW_MATCHES
    if not partners[name].intersection(registered):
        return Reason.ISOLATED
    return Reason.FILTERED
