"""Brute force: the neighbours and the target rule, word by word, in plain loops over floats."""

import math


def similarity(query, row, metric):
    """How alike two states are (lists of floats)."""
    if metric == "euclidean":
        total = 0.0
        for x, y in zip(query, row, strict=True):
            total += (x - y) * (x - y)
        return 1.0 / (1.0 + math.sqrt(total))
    product = size_query = size_row = 0.0
    for x, y in zip(query, row, strict=True):
        product += x * y
        size_query += x * x
        size_row += y * y
    size = math.sqrt(size_query) * math.sqrt(size_row)
    return product / size if size > 0 else -math.inf


def standardise(rows):
    """Mean and deviation of each entry; a constant entry has deviation 1."""
    mean, deviation = [], []
    for column in zip(*rows, strict=True):
        centre = sum(column) / len(column)
        spread = math.sqrt(sum((x - centre) ** 2 for x in column) / len(column))
        mean.append(centre)
        deviation.append(spread if max(column) > min(column) else 1.0)
    return mean, deviation


def ranking(query, rows, metric, dims=None, normalize=False):
    """All rows as (similarity, row), most similar first, ties by the lower row."""
    if not all(math.isfinite(x) for x in query):
        return []
    width = range(len(query)) if dims is None else dims
    query, rows = [query[d] for d in width], [[row[d] for d in width] for row in rows]
    if normalize:
        mean, deviation = standardise(rows)

        def scaled(state):
            return [(x - m) / s for x, m, s in zip(state, mean, deviation, strict=True)]

        query, rows = scaled(query), [scaled(row) for row in rows]
    found = [(similarity(query, row, metric), number) for number, row in enumerate(rows)]
    return sorted(found, key=lambda pair: (-pair[0], pair[1]))


def neighbours(query, rows, metric, k, threshold, dims=None, normalize=False):
    """C_s: the k most similar rows of those similar enough, as (similarity, row)."""
    ranked = ranking(query, rows, metric, dims, normalize)
    return [pair for pair in ranked if pair[0] >= threshold][:k]


def highest(near, columns, horizon, tolerance=0.0, min_offset=0):
    """The paper's rule: the row to go for and the similarity and row of its neighbour."""
    episode, value, remaining = columns["episode"], columns["return_to_go"], columns["remaining"]
    windows = {}
    for _, i in near:
        window = []
        for j in range(i, min(i + horizon, len(episode))):
            if episode[j] == episode[i]:
                window.append(j)
        windows[i] = window[min_offset:] or window[-1:]
    candidates = {j for window in windows.values() for j in window}
    best = max(value[j] for j in candidates)
    good = [j for j in candidates if abs(value[j] - best) <= tolerance]
    target = sorted(good, key=lambda j: (-remaining[j], -value[j], j))[0]
    similar, anchor = next((s, i) for s, i in near if target in windows[i])
    return target, similar, anchor


def followed(near, columns, ahead):
    """The neighbour with the largest return, and the best of its next rows."""
    episode, value, remaining = columns["episode"], columns["return_to_go"], columns["remaining"]
    similar, anchor = sorted(near, key=lambda pair: (-value[pair[1]], -pair[0], pair[1]))[0]
    window = []
    for j in range(anchor, min(anchor + ahead + 1, len(episode))):
        if episode[j] == episode[anchor]:
            window.append(j)
    return sorted(window, key=lambda j: (-value[j], -remaining[j], j))[0], similar, anchor


def target_of(query, columns, search, rule, **limits):
    """Everything that the target module writes for one state.

    Args:
        query: list of floats.
        columns: dict of lists: observation, episode, return_to_go, remaining.
        search: dict: metric, k, threshold, and on demand dims, normalize.
        rule: "highest" or "followed".
        limits: horizon, tolerance, min_offset; or ahead.
    """
    near = neighbours(query, columns["observation"], **search)
    if not near:
        scale = {name: search[name] for name in ("dims", "normalize") if name in search}
        ranked = ranking(query, columns["observation"], search["metric"], **scale)
        own = [x if math.isfinite(x) else 0.0 for x in query]
        best = ranked[0][0] if ranked else -math.inf
        return {"target": own, "found": False, "similarity": best, "target_return": 0.0,
                "target_index": -1, "target_offset": 0}  # fmt: skip
    choose = {"highest": highest, "followed": followed}[rule]
    target, similar, anchor = choose(near, columns, **limits)
    return {"target": columns["observation"][target], "found": True, "similarity": similar,
            "target_return": columns["return_to_go"][target], "target_index": target,
            "target_offset": target - anchor}  # fmt: skip


def for_goal(columns, following, goal, radius, gamma, first_visit=False, expert=None):
    """The columns that a database of the demonstrations for one goal would have.

    Args:
        columns: dict of lists: observation, episode.
        following: the state after each row.
        goal: list of floats, compared with the first entries.
        radius: within which it is reached.
        gamma: discount.
        first_visit: an episode ends where the goal is reached.
        expert: list of rewards of an episode -> bool; all that reach the goal are asked.

    Returns:
        Those of the episodes that are demonstrations, and the row of each in ``columns``.
    """
    out = {"observation": [], "episode": [], "return_to_go": [], "remaining": []}
    rows = []
    for episode in sorted(set(columns["episode"])):
        own = [i for i, e in enumerate(columns["episode"]) if e == episode]
        reward = [float(math.dist(following[i][: len(goal)], goal) <= radius) for i in own]
        if not any(reward) or (expert is not None and not expert(reward)):
            continue
        ends = {len(own) - 1} | {t for t, r in enumerate(reward) if r and first_visit}
        begin = 0
        for end in sorted(ends):
            for t in range(begin, end + 1):
                rows.append(own[t])
                out["observation"].append(columns["observation"][own[t]])
                out["episode"].append((episode, begin))
                out["return_to_go"].append(
                    sum(gamma ** (u - t) * reward[u] for u in range(t, end + 1))
                )
                out["remaining"].append(end - t)
            begin = end + 1
    return out, rows
