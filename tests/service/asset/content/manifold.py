"""What a mesh has to be so that other programs take it: a manifold."""

from collections.abc import Sequence


def check_manifold(faces: Sequence[Sequence[int]]) -> None:
    """Every edge has two faces at most, which are wound alike, and every vertex one fan of faces."""
    directed = [(face[k - 1], face[k]) for face in faces for k in range(len(face))]
    assert len(set(directed)) == len(directed)  # no edge is used twice in one direction
    assert all(len(set(face)) == len(face) for face in faces)
    around: dict[int, dict[int, int]] = {}
    for face in faces:
        for k in range(len(face)):
            around.setdefault(face[k], {})[face[(k + 1) % len(face)]] = face[k - 1]
    for following in around.values():  # from one neighbour of a vertex to the next: one fan is one chain
        starts = set(following) - set(following.values())
        assert len(starts) <= 1
        at, length = (starts or set(following)).pop(), 0
        while at in following and length < len(following):
            at, length = following[at], length + 1
        assert length == len(following)
