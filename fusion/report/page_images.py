"""Camera images as pages show them, and the distance of the points in them."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import FloatArray

WIDEST_PX = 640  # of an image on a page
JPEG_QUALITY = 72


def shown_grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image (H, W) with its contrast stretched to 256 shades."""
    low, high = np.percentile(image, (0.5, 99.5))
    return np.asarray(255.0 * np.clip((image - low) / max(float(high - low), 1.0), 0.0, 1.0), dtype=np.uint8)


def reduced_image(image: NDArray[Any]) -> tuple[NDArray[np.uint8], float]:
    """Return an image as a page shows it, and its pixels per camera pixel."""
    grey = shown_grey(image)
    height, width = grey.shape
    scale = min(1.0, WIDEST_PX / width)
    size = round(width * scale), round(height * scale)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), scale


def jpeg_source(image: NDArray[np.uint8]) -> str:
    """Return a grey or coloured image as an address of a page."""
    shown = image if image.ndim == 2 else image[:, :, ::-1]
    coded = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(coded).decode('ascii')}"


def neighbour_distance(points: FloatArray, least: float) -> float:
    """Return the median distance of neighbours on a grid of points (N, 2).

    Points closer than `least` count as one point.
    """
    sample = points[:: max(1, len(points) // 200)]
    across, down = (np.abs(np.subtract.outer(mine, every)) for mine, every in zip(sample.T, points.T, strict=True))
    distance = np.maximum(across, down)
    distance[distance < least] = np.inf
    return float(np.median(distance.min(axis=1)))
