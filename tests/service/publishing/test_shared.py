from service.mapstore.tiles import TileStore
from service.outputs import Grid
from service.publishing.shared import MapPicture
from tests.service.mapstore.tile_makers import tile


def test_a_picture_of_the_map_is_never_older_than_its_stamp(store: TileStore):
    """A scan that is mapped while the picture is made has its own picture afterwards."""

    class Source:
        def grid(self) -> Grid | None:
            before = store.grid()
            store.update([tile(0, 0, 2)])
            picture.changed(2_000, 2_000)
            return before

    picture = MapPicture(Source())
    store.update([tile(0, 0, 1)])
    picture.changed(1_000, 1_000)
    made = [picture.message() for _ in range(2)]
    assert [(message.stamp_ns, message.log_ns, version) for message, version in made] == [
        (1_000, 1_000, 1),
        (2_000, 2_000, 2),
    ]
