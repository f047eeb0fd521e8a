"""Exports of the calibrated scene as a data set."""

from devrf.capture.formats import DatasetFormat, write_dataset
from devrf.capture.formats.flow_files import Flow
from devrf.capture.scene import PosedFrame
from devrf.flow.store import read_flows
from devrf.pipelines.export.request import Request
from devrf.pipelines.stamps.stamp import STAMP
from devrf.pipelines.trained_scene import trained_scene


def write(chosen: DatasetFormat, request: Request) -> None:
    """Write the scene of a run as a data set; DeVRF's gets the flow as well, where there is some."""
    run_dir = request.run_dir
    scene = trained_scene(run_dir)
    has_flow = chosen == "devrf" and (run_dir / "flow" / STAMP).is_file()
    flows = read_flows(run_dir / "flow") if has_flow else {}
    places = {name: {n: k for k, n in enumerate(flow.index.tolist())} for name, flow in flows.items()}

    def find_flow(frame: PosedFrame) -> Flow | None:
        place = places.get(frame.camera_name, {}).get(frame.index)
        if place is None:
            return None
        flow = flows[frame.camera_name]
        return flow.flow[place].astype("float32"), flow.valid[place]

    with request.disk_told(), request.talk.progress(f"export {chosen}") as progress:
        request.notes = write_dataset(chosen, scene, request.folder, find_flow, progress, request.notes)
