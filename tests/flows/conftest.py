"""Fixtures that tests of the review pages share: the server and the browser."""

import pytest

from worldpose.store.store import Store


@pytest.fixture
def store(project_copy):
    """A project whose every result is there: deciding and waiting needs no orchestrator."""
    return Store.open(str(project_copy))


@pytest.fixture
def app(project_copy):
    import page_client  # late: most tests here need no web framework

    return page_client.served(project_copy)


@pytest.fixture(scope="session")
def reader(tiny_run):
    """A browser of a project that tests only read."""
    import page_client

    return page_client.log_in(page_client.served(tiny_run), "Ada")


@pytest.fixture
def stranger(app):
    import page_client

    return page_client.browser(app)


@pytest.fixture
def ada(app):
    import page_client

    return page_client.log_in(app, "Ada")


@pytest.fixture
def bob(app):
    import page_client

    return page_client.log_in(app, "Bob")


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """A small video."""
    import numpy as np  # late, as the web framework
    from test_page_drafts import FPS, FRAMES, SIZE

    from worldpose.video.files import write_video

    file = tmp_path_factory.mktemp("footage") / "near left.mp4"
    images = (np.full((SIZE[1], SIZE[0], 3), 5 * n, dtype=np.uint8) for n in range(FRAMES))
    write_video(file, images, FPS, quality=30)
    return file


@pytest.fixture
def place(tmp_path):
    """A project, its inbox, and a folder of videos that the operator named."""
    Store.create(str(tmp_path / "project"))
    for name in ("inbox", "videos"):
        (tmp_path / name).mkdir()
    return tmp_path
