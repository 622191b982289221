"""The contestants of the benchmark of the coarse step, all with the same two tasks.

Filter: of the keyframes with a class score of at least one half the best 1000, ranked by cosine, the first ten.
Whole: all keyframes of the map ranked by cosine, the first ten.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from sqlalchemy import bindparam, text

from bench.coarse.fill import MAP_ID
from bench.coarse.world import Query
from semdb.class_score import ClassQuery, class_query, strength_query
from semdb.database.codecs import decode_vectors
from semdb.database.store import Store
from semdb.localization.coarse import CoarseSource
from semdb.localization.ranking import best_first, exact_cosines

FIRST, SHARE, STRONG, AT_MOST = 10, 0.5, 0.2, 1000


class NaiveSql:
    """What one writes first: joins and groups over `objects`, and the vectors of what is left, as blobs."""

    frequencies = text(
        """
        SELECT c.name, COUNT(DISTINCT o.keyframe_id)
        FROM objects o
        JOIN keyframes k ON k.id = o.keyframe_id
        JOIN recordings r ON r.id = k.recording_id
        JOIN categories c ON c.id = o.category_id
        WHERE r.map_id = :map AND c.name IN :names
        GROUP BY c.name
        """
    ).bindparams(bindparam("names", expanding=True))
    total = text("SELECT COUNT(*) FROM keyframes k JOIN recordings r ON r.id = k.recording_id WHERE r.map_id = :map")
    vectors = text("SELECT keyframe_id, vector FROM cnn_vectors WHERE keyframe_id IN :ids").bindparams(
        bindparam("ids", expanding=True)
    )

    def __init__(self, store: Store) -> None:
        self._engine = store.engine

    def filtered(self, query: Query) -> list[int]:
        names = list(query.counts)
        with self._engine.connect() as connection:
            total = connection.execute(self.total, {"map": MAP_ID}).scalar_one()
            known = dict(connection.execute(self.frequencies, {"map": MAP_ID, "names": names}).tuples().all())
            classes = class_query(query.counts, total, known)
            ids = list(connection.execute(*self._filter(classes)).scalars())
            if not ids:
                return []
            rows = sorted(connection.execute(self.vectors, {"ids": ids}).tuples())
        found = np.array([row[0] for row in rows])
        vectors = decode_vectors([row[1] for row in rows], found)
        cosines = vectors.astype(np.float64) @ query.vector.astype(np.float64)
        return [int(i) for i in found[np.lexsort((found, -cosines))][:FIRST]]

    @staticmethod
    def _filter(query: ClassQuery) -> tuple[Any, dict[str, Any]]:
        cases = " ".join(
            f"WHEN :name{i} THEN LEAST({term.full}, {term.per_object} * n.number)" for i, term in enumerate(query.terms)
        )
        statement = f"""
            SELECT n.keyframe_id, SUM(CASE n.name {cases} ELSE 0 END) AS score
            FROM (
                SELECT o.keyframe_id, c.name, COUNT(*) AS number
                FROM objects o
                JOIN keyframes k ON k.id = o.keyframe_id
                JOIN recordings r ON r.id = k.recording_id
                JOIN categories c ON c.id = o.category_id
                WHERE r.map_id = :map AND c.name IN :names
                GROUP BY o.keyframe_id, c.name
            ) n
            GROUP BY n.keyframe_id
            HAVING score >= :least
            ORDER BY score DESC, n.keyframe_id
            LIMIT {AT_MOST}
        """
        values = {f"name{i}": term.category for i, term in enumerate(query.terms)}
        names = [term.category for term in query.terms]
        least = query.least(SHARE)
        prepared = text(statement).bindparams(bindparam("names", expanding=True))
        return prepared, {**values, "map": MAP_ID, "names": names, "least": least}


class Source:
    """semdb's own: with its SQL (`SqlSource`) or its index (`IndexSource`)."""

    def __init__(self, source: CoarseSource) -> None:
        self._source = source
        source.refresh()

    def filtered(self, query: Query) -> list[int]:
        """By counts of objects."""
        source = self._source
        source.refresh()
        frequencies = source.document_frequencies(query.counts)
        return self._ranked(query, class_query(query.counts, source.keyframe_count(), frequencies), SHARE)

    def filtered_by_strength(self, query: Query) -> list[int]:
        """By strengths, which only semdb has."""
        source = self._source
        source.refresh()
        frequencies = source.document_frequencies(query.strengths)
        return self._ranked(query, strength_query(query.strengths, source.keyframe_count(), frequencies), STRONG)

    def _ranked(self, query: Query, classes: ClassQuery, share: float) -> list[int]:
        source = self._source
        ids = source.filtered(classes, share, AT_MOST).keyframe_ids
        cosines = source.cosines(query.vector, ids)
        return [int(i) for i in ids[best_first(ids, cosines, FIRST)]]

    def whole(self, query: Query) -> list[int]:
        self._source.refresh()
        return [int(i) for i in self._source.nearest(query.vector, FIRST, None, 0.0).keyframe_ids]


def exact_ten(store: Store, queries: list[Query], progress: Any) -> np.ndarray:
    """The first ten ``[queries, 10]`` of the whole map by cosine in double precision, read from the database once."""
    ids = np.zeros((len(queries), 0), np.int64)
    cosines = np.zeros((len(queries), 0))
    wanted = np.stack([query.vector for query in queries])
    total, done = store.keyframe_count(MAP_ID), 0
    for keys, vectors in store.iter_vectors(MAP_ID, 5000):
        estimates = vectors @ wanted.T
        for number, query in enumerate(queries):
            # Single precision finds candidates, with some to spare; double precision orders them.
            rows = np.argpartition(-estimates[:, number], 2 * FIRST)[: 2 * FIRST]
            ids_here, cosines_here = keys[rows], exact_cosines(vectors, rows, query.vector)
            if number == 0:
                all_ids = np.zeros((len(queries), len(rows)), np.int64)
                all_cosines = np.zeros((len(queries), len(rows)))
            all_ids[number], all_cosines[number] = ids_here, cosines_here
        ids, cosines = np.concatenate([ids, all_ids], axis=1), np.concatenate([cosines, all_cosines], axis=1)
        order = np.lexsort((ids, -cosines))[:, :FIRST]
        ids, cosines = np.take_along_axis(ids, order, 1), np.take_along_axis(cosines, order, 1)
        done += len(keys)
        progress.update(done, total)
    return ids


class FaissFlat:
    """faiss' exact inner products of float32."""

    name = "faiss IndexFlatIP"

    def __init__(self, vectors: np.ndarray, ids: np.ndarray, threads: int) -> None:
        import faiss

        faiss.omp_set_num_threads(threads)
        self._index = faiss.IndexFlatIP(vectors.shape[1])
        self._index.add(vectors)
        self._ids = ids

    def whole(self, query: Query) -> list[int]:
        return [int(self._ids[i]) for i in self._index.search(query.vector[None], FIRST)[1][0]]


class Hnsw:
    """hnswlib's graph, with its usual parameters."""

    name = "hnswlib (M 16, ef 200)"

    def __init__(self, vectors: np.ndarray, ids: np.ndarray, threads: int) -> None:
        import hnswlib

        self._index = hnswlib.Index("ip", vectors.shape[1])
        self._index.init_index(len(vectors), M=16, ef_construction=200, random_seed=1)
        self._index.set_num_threads(threads)
        self._index.add_items(vectors, ids)
        self._index.set_ef(200)

    def whole(self, query: Query) -> list[int]:
        return [int(i) for i in self._index.knn_query(query.vector[None], FIRST)[0][0]]


def timed(function: Any, queries: list[Query], budget_s: float) -> tuple[list[float], list[list[int]]]:
    """Milliseconds and answers of queries, one after the other, until the time is over; three at least."""
    milliseconds: list[float] = []
    answers: list[list[int]] = []
    started = time.monotonic()
    for query in _until(queries, started, budget_s):
        begin = time.perf_counter()
        answers.append(function(query))
        milliseconds.append((time.perf_counter() - begin) * 1e3)
    return milliseconds, answers


def _until(queries: list[Query], started: float, budget_s: float) -> Iterator[Query]:
    for number, query in enumerate(queries):
        if number >= 3 and time.monotonic() - started > budget_s:
            return
        yield query
