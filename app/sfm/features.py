"""SIFT features of all images into a COLMAP database."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.capture.inventory import Inventory
from app.errors import InputError
from app.sfm.database import list_images, open_database
from app.sfm.options import FeatureExtractor, SfmOptions

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
Grey = NDArray[np.uint8]
Features = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""(N, 4) x, y, scale, orientation in radians, and (N, 128) RootSIFT descriptors (Arandjelovic and Zisserman, 2012)
scaled to bytes. COLMAP's pixel origin: the centre of the top-left pixel is (0.5, 0.5)."""


def extract_features(inventory: Inventory, database_path: Path, options: SfmOptions, progress: Progress) -> None:
    """Compute the features of all images that have none in the database yet.

    Args:
        inventory: the images, and their masks.
        database_path: created if absent.
        options: which and how many features.
        progress: called with images done and images in all.

    Raises:
        InputError: an image or a mask can't be read, or the cameras' parameters are no such.
    """
    cv2.setNumThreads(1)
    gpu = cuda_works(options)
    threads = 1 if gpu else options.threads
    compute = _extractor(options, gpu)
    with open_database(database_path) as database, ThreadPoolExecutor(threads) as pool:
        list_images(database, inventory, options)
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        missing = [image for image in images if not database.exists_descriptors(image.image_id)]
        logger.debug("%s features on %s", "COLMAP" if gpu else options.extractor, "the GPU" if gpu else "the CPU")
        for start in range(0, len(missing), 4 * threads):
            batch = missing[start : start + 4 * threads]
            jobs = [pool.submit(_features_of, inventory, image.name, compute, options) for image in batch]
            with pycolmap.DatabaseTransaction(database):
                for image, job in zip(batch, jobs, strict=True):
                    keypoints, descriptors = job.result()
                    sift = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors)
                    database.write_keypoints(image.image_id, keypoints)
                    database.write_descriptors(image.image_id, sift)
            progress(len(images) - len(missing) + start + len(batch), len(images))


def cuda_works(options: SfmOptions) -> bool:
    """Whether pycolmap was built for CUDA and a GPU is there; the first doesn't imply the second."""
    if not options.use_gpu or not pycolmap.has_cuda or options.extractor is FeatureExtractor.OPENCV:
        return False
    try:
        pycolmap.FeatureExtractor.create(pycolmap.FeatureExtractionOptions(use_gpu=True), pycolmap.Device.cuda)
    except (ValueError, RuntimeError):
        logger.info("this pycolmap can use a GPU, but finds none")
        return False
    return True


def _extractor(options: SfmOptions, gpu: bool) -> Callable[[Grey, Grey | None], Features]:
    if not gpu and options.extractor is not FeatureExtractor.COLMAP:
        return lambda image, mask: opencv_features(image, mask, options.max_num_features)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=gpu, num_threads=1)
    extraction.max_image_size = options.max_image_size_px or -1
    extraction.sift.max_num_features = options.max_num_features
    extraction.sift.first_octave = options.first_octave
    device = pycolmap.Device.cuda if gpu else pycolmap.Device.cpu
    extractor = pycolmap.FeatureExtractor.create(extraction, device)

    def colmap_features(image: Grey, mask: Grey | None) -> Features:
        points, sift = extractor.extract_from_uint8_array(image)
        keypoints = np.asarray(pycolmap.keypoints_to_matrix(points), np.float32)
        descriptors = np.asarray(sift.data, np.uint8)
        if mask is not None and len(keypoints):
            column = np.clip(keypoints[:, 0].astype(int), 0, mask.shape[1] - 1)
            row = np.clip(keypoints[:, 1].astype(int), 0, mask.shape[0] - 1)
            keypoints, descriptors = keypoints[mask[row, column] > 0], descriptors[mask[row, column] > 0]
        return keypoints, descriptors

    return colmap_features


def opencv_features(image: Grey, mask: Grey | None, max_num_features: int) -> Features:
    """OpenCV's SIFT with RootSIFT descriptors.

    Args:
        image: (H, W) grey values.
        mask: (H, W), 0 where no features are wanted.
        max_num_features: half of them the largest, half those of highest contrast.
    """
    # Without precise upscaling OpenCV's keypoints are shifted by a quarter of a pixel.
    sift = cv2.SIFT.create(enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(image, mask)
    if descriptors is None or not len(points):
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    keypoints = np.array([(*point.pt, point.size / 2, np.deg2rad(point.angle)) for point in points], np.float32)
    keypoints[:, :2] += 0.5
    kept = _choose([(point.size, point.response) for point in points], max_num_features)
    keypoints, descriptors = keypoints[kept], descriptors[kept]
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
    return keypoints, np.clip(np.rint(root * 512), 0, 255).astype(np.uint8)


def _choose(size_and_response: list[tuple[float, float]], max_num_features: int) -> NDArray[np.intp]:
    """Rows of the features to keep: half the largest, which match over wide baselines, half those of most contrast."""
    table = np.array(size_and_response)
    largest = np.argsort(-table[:, 0], kind="stable")[: max_num_features // 2]
    table[largest, 1] = np.inf
    return np.sort(np.argsort(-table[:, 1], kind="stable")[:max_num_features])


def _features_of(
    inventory: Inventory, name: str, compute: Callable[[Grey, Grey | None], Features], options: SfmOptions
) -> Features:
    """Features of one image, computed at reduced size if it is large, in the pixels of the full size."""
    image = _read_grey(inventory.image_root / name)
    height, width = image.shape
    mask_file = inventory.mask_root / f"{name}.png" if inventory.mask_root else None
    mask = _read_grey(mask_file) if mask_file is not None and mask_file.exists() else None
    if mask is not None and mask.shape != image.shape:
        raise InputError(f"{mask_file} is not of the size of its image, {width}x{height}; scale it")
    shrink = min(1.0, options.max_image_size_px / max(height, width)) if options.max_image_size_px else 1.0
    if shrink < 1:
        size = (round(width * shrink), round(height * shrink))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        if mask is not None:
            mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    keypoints, descriptors = compute(image, mask)
    keypoints[:, :2] *= np.array([width / image.shape[1], height / image.shape[0]], np.float32)
    keypoints[:, 2] *= width / image.shape[1]
    return keypoints, descriptors


def _read_grey(path: Path) -> Grey:
    """Grey values as stored: COLMAP ignores the EXIF orientation, and so must we."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    if image is None:
        raise InputError(f"{path} is not a readable image; remove or replace it")
    return np.asarray(image, np.uint8)
