"""What else could tell poses and calibration in a campaign: the moving target, gravity in a rotation test. Computed.

    python benchmarks/pose_evidence.py [--write]

Fisher information, nothing drawn but where axes lie. *Target*: the pair of the preset `nitsche2018`, its calibration
as a session of 20 views leaves it, and subsets of the face whose places nobody knows, which the eight recordings of
the preset `matrix` move; pictures, poses of every frame, places of the points and calibration in one adjustment, by
the derivatives of the bundle adjustment. *Gravity*: force outputs and cameras that see the body at every angle of the
head, with cross-talk, the direction of gravity and that of the axis open. *Needed*: U across by how well the pose is
known: `--write` puts this table into docs/campaigns.md. A minute on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from coverage_poses import RUNS, Named, recorded
from marked import markdown_table, write_marked
from numpy.typing import NDArray

from fusion.campaign.unknowns import apply_joint_estimate
from fusion.simulate.preset import Preset, nominal_rig, read_preset
from photogram.calibration.bundle import model_pixels
from photogram.camera import RIG_PARAMETERS, StereoRig, triangulate
from photogram.geometry import RigidTransform, rotation_from_vector, skew
from shaker.labels import MOTION_COMPONENTS

FloatArray = NDArray[np.float64]
PAGE = Path(__file__).parent.parent / "docs" / "campaigns.md"
SUBSETS, FRAMES, NOISE_PX, MATCH_PX = 100, 48, 0.01, 0.01
ACROSS = 5e-4  # rad, of the pair's rotation as it is stated
GROUPS = {
    "focal lengths": ("fx", "fy"), "principal points": ("cx", "cy"), "distortion": ("k1", "k2", "p1", "p2", "k3"),
    "relative rotation": ("rotation.x", "rotation.y", "rotation.z"),
    "baseline": ("translation.x", "translation.y", "translation.z"),
}  # fmt: skip


def motions() -> FloatArray:
    """Return poses (8·F, 6) of the body in the eight recordings: 100 m/s² at 80 Hz (1000 rad/s² of moments), beside
    it a hundredth in all other components, over whole beats.
    """
    phase = 2.0 * np.pi * np.arange(FRAMES) / FRAMES
    size = np.array([100.0] * 3 + [1000.0] * 3) / (2.0 * np.pi * 80.0) ** 2
    found = []
    for run in RUNS:
        share = np.full(6, 0.01)
        share[run.driven] = 1.0
        found.append(np.cos(phase[:, None] + np.arange(6)) * share * size)
    return np.concatenate(found)


def face_points() -> FloatArray:
    """Return points (N, 3) of the face in the sensor frame, side by side on a square grid."""
    side = round(float(np.sqrt(SUBSETS)))
    x, y = np.meshgrid(*[np.linspace(-0.037, 0.037, side)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.0973)], axis=-1)


def adjusted(rig: StereoRig, left: RigidTransform, points: FloatArray, match_px: float, still: bool) -> FloatArray:
    """Return the covariance (24, 24) of the calibration after all pictures, places and poses estimated with it.

    `match_px`: by how much the subsets of the right camera may lie off the same points in all frames; `still`: the
    first frame only, as often. The first pose is the frame, as large an error of a place as 1 m is possible.
    """
    assert rig.covariance is not None
    count, rig_size = len(points), 24
    prior = np.zeros((rig_size + 3 * count + 2 * count,) * 2)
    scale = np.sqrt(np.diagonal(rig.covariance)[:rig_size])
    prior[:rig_size, :rig_size] = np.linalg.inv(rig.covariance[:rig_size, :rig_size] / np.outer(scale, scale))
    prior[:rig_size, :rig_size] /= np.outer(scale, scale)
    own = np.arange(rig_size, len(prior))
    prior[own, own] = np.where(own < rig_size + 3 * count, 1.0, match_px**-2.0)
    information, camera = prior, left.inverse()
    poses = motions()
    for number, pose in enumerate(poses * (not still)):
        rows, by_pose = np.zeros((4 * count, len(prior))), np.zeros((4 * count, 6))
        placed = camera @ RigidTransform.from_pose(pose)
        for side, lens in enumerate((rig.left, rig.right)):
            seen = model_pixels(lens, rig.right_from_left if side else RigidTransform.identity(), placed, points, 0.0)
            here = slice(2 * count * side, 2 * count * (side + 1))
            rows[here, :rig_size] = seen.by_rig(side)[..., :rig_size].reshape(-1, rig_size)
            by_point = rows[here, rig_size : rig_size + 3 * count].reshape(count, 2, count, 3)
            by_point[np.arange(count), :, np.arange(count)] = seen.by_point
            by_pose[here] = seen.by_pose.reshape(-1, 6)
        rows[2 * count :, rig_size + 3 * count :] = np.eye(2 * count)
        if number:  # the first pose is the frame in which places are
            basis = np.linalg.qr(by_pose)[0]
            rows -= basis @ (basis.T @ rows)
        information = information + rows.T @ rows / NOISE_PX**2
    size = np.sqrt(np.diagonal(information))
    return np.asarray((np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size))[:rig_size, :rig_size])


def by_calibration(rig: StereoRig, left: RigidTransform, points: FloatArray, driven: int) -> FloatArray:
    """Return (6, 24): what each parameter changes of a motion along one component, over that motion."""
    assert rig.covariance is not None
    moved = 1e-4 * np.eye(6)[driven]
    in_left = left.inverse()
    places = [in_left.apply(RigidTransform.from_pose(pose).apply(points)) for pose in (-moved, moved)]
    pixels = [rig.project(place) for place in places]

    def motion(by: StereoRig) -> FloatArray:
        behind, ahead = (left.apply(triangulate(by, *(p[None] for p in seen)).position_m[0]) for seen in pixels)
        middle = (behind + ahead) / 2.0
        rows = np.concatenate([np.tile(np.eye(3), (len(middle), 1, 1)), -np.stack([skew(p) for p in middle])], axis=2)
        return np.asarray(np.linalg.lstsq(rows.reshape(-1, 6), (ahead - behind).ravel(), rcond=None)[0])

    nominal, changes = motion(rig), []
    for place, u in enumerate(np.sqrt(np.diagonal(rig.covariance)[:24])):
        step = np.zeros(24)
        step[place] = 0.1 * u
        changes.append((motion(rig.perturbed(step)) - nominal) / step[place])
    return np.asarray(np.array(changes).T / np.linalg.norm(nominal))


def target_rows() -> list[str]:
    """Return what the moving target tells of every group of parameters, and what that does to accelerations across."""
    setup = read_preset(Preset, "nitsche2018").stereo[0]
    rig, left = nominal_rig(setup)
    points = face_points()
    assert rig.covariance is not None
    stated = rig.covariance[:24, :24]
    ways = [(MATCH_PX, True), (MATCH_PX, False), (1e-9, True), (1e-9, False)]
    found = [adjusted(rig, left, points, *way) for way in ways]
    rows = []
    for group, names in GROUPS.items():
        own = [place for place, name in enumerate(RIG_PARAMETERS[:24]) if name.endswith(names)]
        left_of = [np.sqrt(np.diagonal(one)[own] / np.diagonal(stated)[own]) for one in found]
        rows.append(
            f"| {group}: u after / stated | " + " | ".join(f"{x.min():.2f} to {x.max():.2f}" for x in left_of) + " |"
        )
    for driven in (0, 2):
        slopes = by_calibration(rig, left, points, driven)
        for across in (j for j in range(3) if j != driven):
            before, *after = (float(np.sqrt(slopes[across] @ one @ slopes[across])) for one in (stated, *found))
            with_pose = [np.hypot(one, ACROSS) / np.hypot(before, ACROSS) for one in after]
            axes = f"{MOTION_COMPONENTS[across]} under a drive along {MOTION_COMPONENTS[driven]}"
            cells = [f"{one / before:.2f}, {both:.3f}" for one, both in zip(after, with_pose, strict=True)]
            rows.append(
                f"| {axes}, calibration {1e3 * before:.3f} mrad: u after / before, with a pose of 0.5 mrad | "
                + " | ".join(cells)
                + " |"
            )
    return rows


def gravity(cross_talk: float, axes: int, plumb: float) -> FloatArray:
    """Return u (3,) of a pair's rotation by gravity, rad: about the head's (first) axis last.

    The sensor turns in steps of 22.5° about its z axis, then, with two `axes`, about its x axis. Forces over the weight
    are known to 10⁻⁵ but for nine elements of a matrix, 5·10⁻⁴ for those on the diagonal and `cross_talk` for the
    others; cameras know each turn of the body to 2·10⁻⁵ rad, in their own frame, and gravity's direction there to
    `plumb`. Unknown: rotation of the cameras, direction of gravity and of both axes.
    """
    angles = np.deg2rad(np.arange(0.0, 360.0, 22.5))
    ways = [np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])][:axes]
    downs = [np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])]

    def model(p: FloatArray) -> FloatArray:
        """p: rotation of the cameras (3), tilts of the axes (3 each), of gravity at the start (3 each), matrix (9)."""
        matrix, told = np.eye(3) + p[-9:].reshape(3, 3), []
        frame = rotation_from_vector(p[:3])
        for number, (axis, down) in enumerate(zip(ways, downs[:axes], strict=True)):
            own = p[3 + 6 * number : 9 + 6 * number]
            turning, g = rotation_from_vector(own[:3]) @ axis, rotation_from_vector(own[3:]) @ down
            told.append(frame.T @ g / plumb)  # what a plumb line shows in the first picture
            for angle in angles:
                told.append(matrix @ rotation_from_vector(-angle * turning) @ g / 1e-5)
                told.append(frame.T @ (angle * turning) / 2e-5)
        return np.concatenate(told)

    size = 3 + 6 * axes + 9
    slopes = np.stack([(model(e) - model(-e)) / 2e-6 for e in 1e-6 * np.eye(size)], axis=1)
    u = np.concatenate([np.full(3, 1.0), np.full(6 * axes, 1.0), np.where(np.eye(3).ravel() > 0, 5e-4, cross_talk)])
    covariance = np.linalg.inv(slopes.T @ slopes + np.diag(u**-2.0))
    return np.asarray(np.sqrt(np.diagonal(covariance)[:3]))


def gravity_rows() -> list[str]:
    """Return what gravity tells of a pair's rotation, by what is known of cross-talk and seen of a plumb line."""
    rows = []
    for axes, plumb, what in ((1, 1.0, "one axis"), (1, 1e-4, "one axis, a plumb line"), (2, 1.0, "two axes")):
        found = [gravity(cross, axes, plumb) for cross in (1e-2, 1e-3, 3e-4)]
        cells = [", ".join("open" if u > 0.1 else f"{1e3 * u:.2g}" for u in one) for one in found]
        rows.append(f"| {what} | " + " | ".join(cells) + " |")
    return rows


def needed_rows(campaigns: int) -> list[str]:
    """Return u of accelerations across after the matrix campaign, by the u of the pair's rotation as it is stated."""
    rows = []
    for rotation in (5e-3, 1e-3, 5e-4, 2.9e-4, 2e-4, 6e-5):
        sizes: list[list[float]] = [[], []]
        for seed in range(1, 1 + campaigns):
            found = [
                recorded(place, rotation, Named(seed, True, mounting=str(place), recording=str(place)))[0]
                for place in range(len(RUNS))
            ]
            both = found, apply_joint_estimate("c", found, lambda drive: drive)[0]
            for size, entries in zip(sizes, both, strict=True):
                for entry, run in zip(entries, RUNS, strict=True):
                    for drive in entry.excited_lines:
                        variance = np.diagonal(drive.load_uncertainty.covariance[0])
                        u = np.sqrt((variance[:3] + variance[6:9]) / 2.0) / np.linalg.norm(drive.load[:3])
                        size += [float(u[j]) for j in range(3) if j != run.driven]
        before, after = (1e3 * float(np.median(size)) for size in sizes)
        rows.append(f"| {1e3 * rotation:.2g} | {before:.2g} | {after:.2g} | {after / before:.2f} |")
    return rows


def main(arguments: Sequence[str] = ()) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=3)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args(arguments)
    head = (
        "| pose rotation stated / mrad | u across, each recording / 10⁻³ | after the campaign / 10⁻³ | after / before |"
    )
    tables = {
        "gravity": markdown_table("| turned about | cross-talk to 10⁻² | to 10⁻³ | to 3·10⁻⁴ |", gravity_rows()),
        "target": markdown_table(
            "| | at rest | all recordings | at rest, noise alone | all recordings, noise alone |", target_rows()
        ),
        "needed": markdown_table(head, needed_rows(options.campaigns)),
    }
    for text in tables.values():
        print(text, flush=True)
    if options.write:
        write_marked(PAGE, {"needed": tables["needed"]})


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
