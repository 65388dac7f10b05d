"""Small recordings in each format, made by its library, of an environment whose next observation is the action."""

import csv
import io
import json
import warnings

import numpy as np
from PIL import Image

from forbes.data.episodes.episode import Episode

__all__ = ["FORMATS", "SIDE", "episodes", "pictures", "write"]

SIDE = 32
"""Side of the pictures in pixels."""
FPS = 10


def episodes(count=3, images=False, seed=0):
    """Return episodes with o_t = (a_{t-1}, t) and r_t = 10 a_{t-1} + t, of different lengths; odd ones terminate."""
    random, found = np.random.default_rng(seed), []
    for number in range(count):
        steps = 4 + number
        action = np.concatenate([[[0.0]], random.uniform(-1, 1, (steps, 1))]).astype(np.float32)  # (T + 1, 1)
        time = np.arange(steps + 1, dtype=np.float32)
        observation = pictures(action) if images else np.stack([action[:, 0], time], 1)
        reward = np.where(time > 0, 10 * action[:, 0] + time, 0).astype(np.float32)
        found.append(Episode(observation, action, reward, bool(number % 2), steps))
    return found


def pictures(action):
    """Return a picture per action, uint8 `(T + 1, 3, SIDE, SIDE)`: its grey is 127 + 100 a."""
    grey = np.round(127 + 100 * action).astype(np.uint8)  # (T + 1, 1)
    return np.tile(grey[:, :, None, None], (1, 3, SIDE, SIDE))


def channels_last(episode):
    """Return the observations as other software stores them."""
    return episode.observation.transpose(0, 2, 3, 1) if episode.observation.ndim == 4 else episode.observation


def following(episode):
    """Return o_t, a_t and r_t, of which a_t and r_t follow o_t; the last observation has none."""
    return channels_last(episode), episode.action[1:], episode.reward[1:]


def dreamer(path, recorded):
    path.mkdir()
    for number, episode in enumerate(recorded):
        last = np.arange(len(episode.reward)) == len(episode.reward) - 1
        arrays = {"image" if episode.observation.ndim == 4 else "state": channels_last(episode)}
        ends = {"is_first": last[::-1], "is_terminal": last & episode.terminated}
        np.savez_compressed(path / f"{number:03d}.npz", action=episode.action, reward=episode.reward, **arrays, **ends)
    return path


def dreamer_v1(path, recorded):
    path.mkdir()
    for number, (observation, action, reward, terminated, _) in enumerate(recorded):
        discount = np.ones(len(reward), np.float16)
        discount[-1] = not terminated
        np.savez(path / f"{number:03d}.npz", state=observation, action=action, reward=reward, discount=discount)
    return path


def robomimic(path, recorded, after=True):
    import h5py

    with h5py.File(path, "w") as file:
        for number in range(len(recorded) - 1, -1, -1):  # not in their order
            observation, action, reward = following(recorded[number])
            demo = file.create_group(f"data/demo_{number}")
            demo["obs/state"], demo["actions"], demo["rewards"] = observation[:-1], action, reward
            demo["dones"] = np.arange(len(action)) == (len(action) - 1 if recorded[number].terminated else -1)
            if after:
                demo["next_obs/state"] = observation[1:]
    return path


def d4rl(path, recorded, after=True):
    import h5py

    with h5py.File(path, "w") as file:
        parts = [following(episode) for episode in recorded]
        file["observations"] = np.concatenate([observation[:-1] for observation, _, _ in parts])
        file["actions"] = np.concatenate([action for _, action, _ in parts])
        file["rewards"] = np.concatenate([reward for *_, reward in parts])
        ends = np.cumsum([len(action) for _, action, _ in parts]) - 1
        ended = np.array([episode.terminated for episode in recorded])
        for name, positions in (
            ("terminals", ends[ended]),
            ("timeouts", ends[~ended][:-1]),
        ):  # the last one has no flag
            file[name] = np.isin(np.arange(ends[-1] + 1), positions)
        file["infos/qpos"] = file["observations"][:]
        file["metadata/algorithm"] = "none"
        if after:
            file["next_observations"] = np.concatenate([observation[1:] for observation, _, _ in parts])
    return path


def ends_file(path, recorded):
    import h5py

    with h5py.File(path, "w") as file:
        parts = [following(episode) for episode in recorded]
        file["obs"] = np.concatenate([observation[:-1] for observation, _, _ in parts])
        file["action"] = np.concatenate([action for _, action, _ in parts])
        file["reward"] = np.concatenate([reward for *_, reward in parts])
        file["meta/episode_ends"] = np.cumsum([len(action) for _, action, _ in parts])
    return path


def columns(recorded):
    """Return the columns of stable-worldmodel: the action is moved ahead, and the last one is the first again."""
    for episode in recorded:
        first = np.full_like(episode.action[:1], np.nan)
        reward = np.where(np.arange(len(episode.reward)) == 0, np.nan, episode.reward).astype(np.float32)
        last = np.arange(len(reward)) == len(reward) - 1
        yield {
            "pixels" if episode.observation.ndim == 4 else "state": channels_last(episode),
            "action": np.concatenate([episode.action[1:], first]),
            "reward": reward,
            "terminated": last & episode.terminated,
        }


def stable_worldmodel(path, recorded):
    import h5py

    tables = list(columns(recorded))
    lengths = np.array([len(table["action"]) for table in tables], np.int32)
    with h5py.File(path, "w", libver="latest") as file:
        for name in tables[0]:
            file[name] = np.concatenate([table[name] for table in tables])
        file["ep_len"], file["ep_offset"] = lengths, np.cumsum(lengths) - lengths
    return path


def lance(path, recorded):
    import lance as library
    import pyarrow as pa

    tables = []
    for number, table in enumerate(columns(recorded)):
        steps = len(table["action"])
        arrays = {"episode_idx": pa.array([number] * steps, pa.int32()), "step_idx": pa.array(range(steps), pa.int32())}
        for name, values in table.items():
            if values.ndim == 4:
                arrays[name] = pa.array([jpeg(value) for value in values], pa.binary())
                continue
            rows = values.reshape(steps, -1).astype(np.float32)
            arrays[name] = pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), rows.shape[1])
        tables.append(pa.table(arrays))
    library.write_dataset(pa.concat_tables(tables), str(path.with_suffix(".lance")))
    return path.with_suffix(".lance")


def jpeg(picture):
    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="JPEG", quality=95)
    return content.getvalue()


def minari(path, recorded):
    from gymnasium import spaces
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    observations = spaces.Box(-np.inf, np.inf, recorded[0].observation.shape[1:], np.float32)
    path.mkdir()
    storage = MinariStorage.new(path, observations, spaces.Box(-1, 1, (1,)), data_format="hdf5")
    storage.update_metadata({"dataset_id": "toy/test-v0", "minari_version": "0.5.0"})
    for number, episode in enumerate(recorded):
        observation, action, reward = following(episode)
        last = np.arange(len(action)) == len(action) - 1
        ends = {"terminations": last & episode.terminated, "truncations": last & (not episode.terminated)}
        storage.update_episodes([EpisodeBuffer(number, None, None, observation, action, reward, **ends)])
    return path


def table(path, episode, whole=True):
    """Write the actions of an episode; those of the last frame only if `whole`."""
    _, action, reward = following(episode)
    with path.open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["push", "reward", "terminated"])
        for step in range(len(action)):
            lines.writerow([action[step, 0], reward[step], int(episode.terminated and step == len(action) - 1)])
        if whole:
            lines.writerow([0.0, 0.0, int(episode.terminated)])


def png(path, recorded):
    for number, episode in enumerate(recorded):
        folder = path / f"take-{number}"
        folder.mkdir(parents=True)
        for step, picture in enumerate(channels_last(episode)):
            Image.fromarray(picture).save(folder / f"{step:04d}.png")
        table(folder / "actions.csv", episode, whole=bool(number % 2))
    return path


def mp4(path, recorded):
    path.mkdir()
    for number, episode in enumerate(recorded):
        film(path / f"take-{number}.mp4", channels_last(episode))
        table(path / f"take-{number}.csv", episode)
    return path


def film(path, frames):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def lerobot(path, recorded, camera="video"):
    """Write the layout of LeRobot v3: all episodes in one parquet file, and in one video."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    views = [pictures(episode.action).transpose(0, 2, 3, 1) for episode in recorded]
    for name in ("meta/episodes/chunk-000", "data/chunk-000", "videos/observation.images.top/chunk-000"):
        (path / name).mkdir(parents=True)
    rows, about, start = [], [], 0
    for number, episode in enumerate(recorded):
        steps = len(episode.reward)
        action = np.concatenate([episode.action[1:], np.zeros((1, 1), np.float32)])
        reward = np.concatenate([episode.reward[1:], np.zeros(1, np.float32)])
        arrays = {
            "observation.state": pa.array(list(episode.observation), pa.list_(pa.float32())),
            "action": pa.array(list(action), pa.list_(pa.float32())),
            "next.reward": pa.array(reward),
            "timestamp": pa.array((np.arange(steps) / FPS).astype(np.float32)),
            "episode_index": pa.array([number] * steps, pa.int64()),
        }
        if camera == "image":
            values = [{"bytes": png_bytes(view), "path": "../../elsewhere.png"} for view in views[number]]
            arrays["observation.images.top"] = pa.array(values)
        rows.append(pa.table(arrays))
        place = {"chunk_index": 0, "file_index": 0}
        seconds = {"from_timestamp": start / FPS, "to_timestamp": (start + steps) / FPS}
        about.append(
            {"episode_index": number, "length": steps, "tasks": ["push"], "stats/action/min": [0.0]}
            | {f"data/{name}": value for name, value in place.items()}
            | {f"videos/observation.images.top/{name}": value for name, value in (place | seconds).items()}
        )
        start += steps
    with pq.ParquetWriter(path / "data/chunk-000/file-000.parquet", rows[0].schema) as file:
        for each in rows:
            file.write_table(each)
    pq.write_table(pa.Table.from_pylist(about), path / "meta/episodes/chunk-000/file-000.parquet")
    if camera == "video":
        film(path / "videos/observation.images.top/chunk-000/file-000.mp4", np.concatenate(views))
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": ["place", "time"]},
        "observation.images.top": {"dtype": camera, "shape": [SIDE, SIDE, 3], "names": ["height", "width", "channels"]},
        "action": {"dtype": "float32", "shape": [1], "names": ["push"]},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    info = {"codebase_version": "v3.0", "fps": FPS, "features": features}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (path / "meta/info.json").write_text(json.dumps(info))
    return path


def png_bytes(picture):
    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="PNG")
    return content.getvalue()


FORMATS = {
    "dreamer": dreamer,
    "dreamer-v1": dreamer_v1,
    "robomimic": robomimic,
    "robomimic-short": lambda path, recorded: robomimic(path, recorded, after=False),
    "d4rl": d4rl,
    "d4rl-short": lambda path, recorded: d4rl(path, recorded, after=False),
    "episode-ends": ends_file,
    "stable-worldmodel": stable_worldmodel,
    "minari": minari,
    "lerobot": lerobot,
    "lance": lance,
    "png": png,
    "mp4": mp4,
}
"""Functions that write episodes to a path in some format, and return the path."""
LIBRARIES = {"robomimic": "h5py", "d4rl": "h5py", "episode": "h5py", "stable": "h5py", "minari": "minari"}
LIBRARIES |= {"lerobot": "pyarrow", "lance": "lance", "mp4": "av"}


def write(name, path, recorded):
    """Write episodes in a format; skip the test if its library is not installed."""
    import pytest

    if library := LIBRARIES.get(name.split("-")[0]):
        pytest.importorskip(library)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, while they write
        return FORMATS[name](path, recorded)
