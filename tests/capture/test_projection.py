"""Pictures that no lens makes: told by what files say, else by what is seen; a wide lens's are not called so."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from devrf.calibration.preview.stability import steadiness
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.ingest.survey import look_at
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.upright_pictures import probe_picture
from devrf.capture.projection import of_sphere, of_xmp, projection_of
from devrf.capture.video.reader import probe_video
from devrf.pipelines.check.clip_pictures import planned_frames
from devrf.pipelines.init.material import FootageContent
from devrf.pipelines.init.roles import guess_roles

HEIGHT, WIDTH = 80, 160
RNG = np.random.default_rng(0)
WORLD = cv2.GaussianBlur(RNG.integers(0, 256, (64, 64, 64)).astype(np.float32), (0, 0), 0.8)


def all_around(turn: float) -> np.ndarray:
    """A ball of many colours, seen from its middle; columns are longitudes, rows latitudes."""
    longitude = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi + turn
    latitude = np.pi / 2 - (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    x = np.cos(latitude)[:, None] * np.cos(longitude)
    y = np.cos(latitude)[:, None] * np.sin(longitude)
    z = np.broadcast_to(np.sin(latitude)[:, None], x.shape)
    at = [np.clip(((axis + 1) * 12).round().astype(int) + 5, 0, 63) for axis in (x, y, z)]
    grey = WORLD[at[0], at[1], at[2]]
    return np.repeat(np.clip(4 * (grey - 128) + 128, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def wide(shift: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """A wall of blobs, by a lens."""
    wall = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (400, 400)).astype(np.float32), (0, 0), 2
    )
    part = 6 * (wall[20 : 20 + size[1], shift : shift + size[0]] - 128) + 128
    return np.repeat(np.clip(part, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def circles(shift: int) -> np.ndarray:
    picture, mask = wide(shift), np.zeros((HEIGHT, WIDTH), np.uint8)
    for x in (HEIGHT // 2, WIDTH - HEIGHT // 2):
        cv2.circle(mask, (x, HEIGHT // 2), HEIGHT // 2 - 2, 255, -1)
    return np.where(mask[:, :, None] > 0, picture, 3).astype(np.uint8)


def eyes(shift: int) -> np.ndarray:
    return np.hstack([wide(shift, (HEIGHT, HEIGHT)), wide(shift + 4, (HEIGHT, HEIGHT))])


def wall_of_one_colour(shift: int) -> np.ndarray:
    """Both edges alike, first and last row plain, and yet a lens's: a subject before a screen."""
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    picture[20:60, 40 + shift : 100 + shift] = wide(0, (60, 40))
    return picture


MAKERS = {"equirectangular": all_around, "fisheyes": circles, "eyes": eyes, None: wide}


@pytest.mark.parametrize("kind", MAKERS)
def test_what_is_seen(kind):
    assert projection_of([], [MAKERS[kind](n) for n in range(5)]) == kind


def test_what_is_no_sign():
    assert projection_of([None], [wall_of_one_colour(n) for n in range(5)]) is None
    assert projection_of([], [wide(n, (160, 90)) for n in range(5)]) is None
    assert projection_of([], [np.zeros((80, 160, 3), np.uint8)]) is None and projection_of([], []) is None
    assert projection_of(["eyes"], [wide(0)]) == "eyes"  # a file knows better


def test_what_files_say(tmp_path):
    assert of_sphere(struct.pack("=i28x", 0), None) == "equirectangular"
    assert of_sphere(struct.pack("=i28x", 4), None) is None and of_sphere(None, struct.pack("=i", 0)) is None
    assert of_sphere(None, struct.pack("=i", 1)) == "eyes" and of_sphere(b"", b"") is None
    assert of_xmp(None) is None and of_xmp("<x:xmpmeta/>") is None
    tag = b'<rdf GPano:ProjectionType="equirectangular"/>'
    Image.fromarray(wide(0)).save(tmp_path / "a.jpg", xmp=tag)
    assert probe_picture(tmp_path / "a.jpg").projection == "equirectangular"
    assert of_xmp("<GPano:ProjectionType>cylindrical</GPano:ProjectionType>") == "panorama"


GOOGLE = (  # Spherical Video V1
    b"<?xml version='1.0'?><rdf:SphericalVideo xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#' "
    b"xmlns:GSpherical='http://ns.google.com/videos/1.0/spherical/'><GSpherical:Spherical>true</GSpherical:Spherical>"
    b"<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:StitchingSoftware>x</GSpherical:StitchingSoftware>"
    b"<GSpherical:ProjectionType>equirectangular"
    b"</GSpherical:ProjectionType></rdf:SphericalVideo>"
)


def with_box(path: Path, xml: bytes) -> None:
    """Put Google's box behind everything else in the first track; the index is at the file's end."""
    data = path.read_bytes()
    moov = data.rindex(b"moov") - 4
    trak = data.index(b"trak", moov) - 4
    box = bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + xml
    box = struct.pack(">I4s", 8 + len(box), b"uuid") + box
    end = trak + struct.unpack_from(">I", data, trak)[0]
    data = bytearray(data[:end] + box + data[end:])
    for at in (moov, trak):
        struct.pack_into(">I", data, at, struct.unpack_from(">I", data, at)[0] + len(box))
    path.write_bytes(bytes(data))


def test_a_clip_that_says_so(make_clip, pictures):
    path = make_clip("a.mp4", pictures)
    assert probe_video(path).projection is None
    with_box(path, GOOGLE)
    assert probe_video(path).projection == "equirectangular"


@pytest.mark.parametrize("kind", ["equirectangular", "eyes", None])
def test_clips_and_photos_are_told_by_all_commands(make_clip, tmp_path, kind):
    """`run` (clips and photos), `check` and `init`."""
    pictures = [MAKERS[kind](n) for n in range(12)]
    path = make_clip("a.mp4", pictures, times_s=[n / 2 for n in range(12)])
    folder = tmp_path / "photos"
    folder.mkdir()
    for n, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{n}.jpg", quality=95)
    look = look_at(path, 8)
    found = [
        extract_clip(path, tmp_path, "a", "sweep", "a.mp4", Keep()).frames.faults,
        extract_folder(folder, tmp_path, "b", "sweep", "photos").faults,
        planned_frames(look, "sweep", "a.mp4").faults,
    ]
    whys = [[f.why for f in faults if f.code == "coding"] for faults in found]
    assert whys == [[kind] if kind else []] * 3
    roles = guess_roles([FootageContent(look, "a.mp4", steadiness(look.greys), 0.0)], None)
    assert ("a.mp4" in roles.left) == (kind is not None)


@pytest.mark.parametrize("count", [1, 6])
@pytest.mark.parametrize("width", [64, 160])
def test_panoramas_among_photos_are_no_camera(tmp_path, count, width):
    """However many there are, and of what size: a camera of their own would have a lens that there is not."""
    rng, folder = np.random.default_rng(0), tmp_path / "photos"
    folder.mkdir()
    for n in range(20):
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8)).save(folder / f"IMG_{n}.jpg")
    tag = b'<rdf GPano:ProjectionType="cylindrical"/>'
    for n in range(count):
        picture = Image.fromarray(rng.integers(0, 255, (48, width, 3), np.uint8))
        picture.save(folder / f"PANO_{n}.jpg", xmp=tag)
    got = extract_folder(folder, tmp_path, "static", "sweep", "photos")
    assert sorted(str(f.photo) for f in got.used) == sorted(f"IMG_{n}.jpg" for n in range(20))
    assert sum(f"{count} of {20 + count} photos are panoramas" in note for note in got.notes) == 1
    assert not any(fault.code == "coding" for fault in got.faults)
    assert look_at(folder, 12).projection is None
