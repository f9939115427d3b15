"""COLMAP's pose priors: camera positions with covariance, and a script that stores them.

By COLMAP's geometry/pose_prior.h and doc/faq.rst. COLMAP has no control points. Its prior is the
position of the camera in a Cartesian world with a covariance, in the database's own table, by
image; ids of images are those of the user's database, hence the script.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files as resources

from kgcp.errors import KgcpError
from kgcp.io.exporters.local_frame import describe_frame, local_cameras
from kgcp.io.exporters.points import MapPoints, decimals, image_names, upper

_FOLDER = "colmap"
_COLUMNS = "image,x,y,z,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
_HOWTO = """\
COLMAP

COLMAP takes no control points and no distances. It takes camera positions with their covariance,
here from the plate and its vehicle's attitude, for the images that show the target.

1. colmap feature_extractor --database_path database.db --image_path frames
   (images go by their path below that folder, as in pose_priors.csv)
2. python add_pose_priors.py database.db        needs pycolmap (pip install pycolmap)
   It replaces priors of these images, keeps those of others and says how many. Add --only to remove
   them: GPS from EXIF is WGS 84 and cannot be mixed with these Cartesian priors, and those of an
   earlier export may be in a frame of another origin.
3. colmap exhaustive_matcher --database_path database.db        or another matcher
4. colmap pose_prior_mapper --database_path database.db --image_path frames --output_path sparse
   without --overwrite_priors_covariance, which would discard the covariances.

Or, after an ordinary reconstruction, by positions only, which then all have the same weight; the
error is the largest distance of a camera from its position [m]:
  colmap model_aligner --input_path sparse/0 --output_path aligned \
    --ref_images_path reference.txt --ref_is_gps 0 --alignment_max_error 1

{frame}
The covariances of pose_priors.csv are in these axes [m²].
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the priors, a script that writes them, and a list for `model_aligner`.

    Raises
    ------
    KgcpError
        If there is no prior with a covariance, or an image's path has white space, a comma or a
        quote.
    """
    names = image_names(
        (prior.frame for prior in points.priors), _FOLDER, r'\s,"', keep_folder=True
    )
    table, reference = [_COLUMNS], []
    for prior, position, axes in zip(points.priors, *local_cameras(points), strict=True):
        if prior.cov is None:
            continue
        cov = axes @ prior.cov[:3, :3] @ axes.T
        xyz = [decimals(value) for value in position]
        triangle = (f"{value:.12e}" for value in upper(cov))
        table.append(",".join((names[prior.frame], *xyz, *triangle)))
        reference.append(" ".join((names[prior.frame], *xyz)))
    if not reference:
        raise KgcpError(
            f"{_FOLDER}: there is no camera position with a covariance, and COLMAP takes nothing"
            " else; this needs unambiguous poses of a plate on a vehicle (column ambiguity), and"
            " sd_roll_deg, sd_pitch_deg, sd_heading_deg and sd_x, sd_y, sd_z in its trajectory"
        )
    script = resources("kgcp.io.exporters").joinpath("scripts/colmap_pose_priors.txt")
    texts = {
        "HOWTO.txt": _HOWTO.format(frame=describe_frame(points)),
        "pose_priors.csv": "\n".join(table) + "\n",
        "reference.txt": "\n".join(reference) + "\n",
        "add_pose_priors.py": script.read_text(encoding="utf-8"),
    }
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}
