"""The records of `benchmarks.speed.speed`, from the rows that it has printed."""

from collections.abc import Iterator
from pathlib import Path

from benchmarks import record

CANDIDATES = {
    "jaxreg": ("jaxreg, batch {batch}", "jaxreg, batch of {batch}"),
    "jaxreg_one": ("jaxreg, batch 1", "jaxreg, one pair"),
    "as_written": (
        "transcription, batch {batch}",
        "the equations as first written, batch of {batch}",
    ),
    "ransac_icp": ("open3d_ransac_icp", "Open3D FPFH + RANSAC + ICP"),
    "fgr_gicp": ("open3d_fgr_gicp", "Open3D FGR + GICP"),
    "small_gicp": ("small_gicp", "small_gicp GICP (a local method)"),
}
"""Rows of the records: the candidate, and what a reader sees."""
STAGES = {
    "graphs": ("graphs",),
    "features": ("features",),
    "feature_distance": ("feature distance",),
    "nn_distance": ("1-NN distance",),
    "maps": ("maps M, M-hat, G",),
    "final_map": ("final map, copy",),
    "inliers": ("inliers", "Procrustes"),
}
PROGRAMS = {
    "forward_1": "jaxreg, forward, batch 1",
    "forward_8": "jaxreg, forward, batch 8",
    "step_4": "jaxreg, step, batch 4",
    "step_8": "jaxreg, step, batch 8",
    "forward_as_written": "transcription, forward, batch 8",
    "gradient_as_written": "transcription, gradient, batch 4",
}
VARIANTS = {
    "library": "the library",
    "fusion": "compiled without the library YNN",
    "sorting": "neighbours by sorting",
    "indexing": "neighbourhood sums by indexing",
    "blocks": "matching in blocks of rows",
    "written_out": "nothing hoisted, iterations written out",
    "one_pair": "one pair at a time",
    "padded": "padded by a quarter",
    "as_written": "the equations as first written",
}
Rows = dict[str, dict[str, record.Value]]


def write(results: dict[str, list], options) -> Iterator[Path]:
    """A record for every part that was measured; `options` are those of the benchmark."""
    if "forward" in results and options.cores == 1:
        yield one_core(results["forward"][0], options)
    elif "forward" in results:
        yield speed(results, options)
        yield sizes(results["forward"], options)
    if "stages" in results:
        yield stages(results["stages"], options)
    if "programs" in results:
        yield processes(results["programs"])
    if "accuracy" in results:
        yield accuracy(results["accuracy"])


def _write(name: str, question: str, columns: dict, rows: Rows, setting: dict) -> Path:
    return record.write(
        name,
        question=question,
        command=record.command("benchmarks.speed.speed"),
        columns=columns,
        rows=rows,
        setting=setting,
    )


def by_candidate(rows: list[dict], options) -> dict[str, dict]:
    """The rows of one size by the names of the records, those that took part."""
    found = {row["candidate"]: row for row in rows}
    names = {key: name.format(batch=options.batch) for key, (name, _) in CANDIDATES.items()}
    return {key: found[name] for key, name in names.items() if name in found}


def label(key: str, options) -> str:
    """What a reader sees of a candidate."""
    return CANDIDATES[key][1].format(batch=options.batch)


def speed(results: dict[str, list], options) -> Path:
    """The first size: forward pass and training step, beside the equations as first written."""
    found = by_candidate(results["forward"][0], options)
    milliseconds = {key: 1e3 * row["minimum"] for key, row in found.items()}
    rows: Rows = {}
    for key, name in (("forward", "jaxreg"), ("forward_one", "jaxreg_one"), ("ransac_icp",) * 2):
        if name in found:
            text = label(name, options).replace("jaxreg", "forward")
            rows[key] = {"label": text, "ms": milliseconds[name], "faster": None}
            if "as_written" in found and key != "ransac_icp":
                rows[key]["faster"] = milliseconds["as_written"] / milliseconds[name]
    if training := {row["candidate"]: 1e3 * row["minimum"] for row in results.get("training", [])}:
        step, written = training["jaxreg, step"], training["transcription, gradient"]
        text = f"training step, batch of {options.batch}"
        rows["step"] = {"label": text, "ms": step, "faster": written / step}
        text = "gradient of the equations as first written"
        rows["gradient_as_written"] = {"label": text, "ms": written, "faster": None}
    setting = {"points": options.points[0], "batch": options.batch}
    for row in results.get("first", []):
        task = row["first result"].removeprefix("jaxreg.")
        cache = {"empty": "cold"}.get(row["cache"], row["cache"])
        setting[f"{task}_{cache}_s"] = round(row["process, s"], 1)
    columns = {"ms": "ms a pair", "faster": "times faster than the equations as they stand"}
    return _write("speed", "How fast is the network?", columns, rows, setting)


def one_core(forward: list[dict], options) -> Path:
    """The first size on one core, over the time of a batch of the library."""
    found = by_candidate(forward, options)
    first = found["jaxreg"]["minimum"]
    rows: Rows = {
        key: {
            "label": label(key, options),
            "ms": 1e3 * row["minimum"],
            "ratio": row["minimum"] / first,
        }
        for key, row in found.items()
    }
    rows["forward"] = rows.pop("jaxreg")
    columns = {"ms": "ms a pair", "ratio": "over jaxreg"}
    return _write("speed_one_core", "And on one core?", columns, rows, {})


def sizes(forward: list[list[dict]], options) -> Path:
    """Every candidate at every size, and from which size on a classical pipeline is faster."""
    rows: Rows = {}
    setting: dict[str, record.Value] = {}
    for points, size in zip(options.points, forward, strict=True):
        found = by_candidate(size, options)
        for key, row in found.items():
            rows.setdefault(key, {"label": label(key, options)})
            rows[key][f"ms_{points}"] = 1e3 * row["minimum"]
            rows[key][f"deg_{points}"] = row["median_error_deg"]
        classical = [x["minimum"] for k, x in found.items() if k in ("ransac_icp", "fgr_gicp")]
        if classical and min(classical) < found["jaxreg"]["minimum"]:
            setting.setdefault("slower_from", points)
        if "as_written" in found and "as_written_ratio" not in setting:
            ratio = found["as_written"]["minimum"] / found["jaxreg"]["minimum"]
            setting["as_written_ratio"] = round(ratio, 1)
    heads = {"ms": "ms", "deg": "median error, deg"}
    columns = {f"{k}_{n}": f"{n} points: {x}" for k, x in heads.items() for n in options.points}
    return _write("sizes", "How does it compare on larger clouds?", columns, rows, setting)


def stages(found: list[dict], options) -> Path:
    """Calls, arithmetic and time of every stage."""
    *parts, whole = found
    rows: Rows = {}
    for key, names in STAGES.items():
        chosen = [row for row in parts if row["stage"] in names]
        operations, seconds = (sum(row[x] for row in chosen) for x in ("operations", "seconds"))
        rows[key] = {
            "label": ", ".join(names),
            "calls": chosen[0]["calls"],
            "mflop": operations / 1e6,
            "ms": 1e3 * seconds,
            "share": operations / seconds / whole["rate"],
        }
    question = (
        f"Where does the time of a forward pass go ({options.points[0]} points, batch of "
        f"{options.batch})?"
    )
    columns = {"calls": "calls", "mflop": "MFLOP", "ms": "ms a pair"}
    columns["share"] = "share of the matrix rate"
    setting = {"gflops": round(whole["rate"] / 1e9), "whole_ms": 1e3 * whole["seconds"]}
    return _write("stages", question, columns, rows, setting)


def processes(found: list[dict]) -> Path:
    """Compile time and memory of a fresh process for each program."""
    columns = {
        "trace": ("trace, s", "trace, s"),
        "compile": ("compile, s", "compile, s"),
        "peak": ("peak, MB", "peak, MB"),
        "arrays": ("arrays", "arrays, MB"),
        "peak_warm": ("peak, warm", "peak with a warm cache, MB"),
    }
    of_program = {row["program"]: row for row in found}
    rows: Rows = {
        key: {"label": name} | {c: of_program[name][x] for c, (x, _) in columns.items()}
        for key, name in PROGRAMS.items()
        if name in of_program
    }
    heads = {key: head for key, (_, head) in columns.items()}
    return _write("processes", "What does a fresh process cost?", heads, rows, {})


def accuracy(found: list[dict]) -> Path:
    """Every variant in float32, and how far they are apart in float64."""
    single = {row["variant"]: row for row in found if row["dtype"] == "float32"}
    double = [row for row in found if row["dtype"] == "float64"]
    rows: Rows = {
        key: {
            "label": name,
            "mae_r": single[name]["mae_r_deg"],
            "worst": single[name]["worst_deg"],
            "difference": single[name]["difference_deg"],
            "apart": single[name]["apart_deg"],
        }
        for key, name in VARIANTS.items()
    }
    columns = {"mae_r": "MAE(R)", "worst": "worst", "difference": "MAE(R) less the first row's"}
    columns["apart"] = "farthest apart for a pair"
    setting = {
        "float64_apart": max(row["apart_deg"] for row in double),
        "float64_mae_r": double[0]["mae_r_deg"],
        "float64_worst": double[0]["worst_deg"],
    }
    question = "What does speed cost in accuracy (float32, degrees)?"
    return _write("accuracy", question, columns, rows, setting)
