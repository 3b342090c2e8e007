"""What tests of pages share."""

import time


def listened(window):
    window.told, window.problems, window.asked = [], [], []
    window.on("console", lambda message: window.told.append(message.text))
    for errors in (window.told, window.problems):
        window.on("pageerror", lambda error, errors=errors: errors.append(str(error)))
    window.on("request", lambda request: window.asked.append(request.url))
    return window


def asked_of_a_network(window):
    return [url for url in window.asked if not url.startswith(("file:", "data:", "blob:"))]


def picture_of(window, **clip):
    """What a window shows, all of it or a part, shape (H, W, 3)."""
    import imageio.v3 as iio

    return iio.imread(window.screenshot(clip=clip or None))[..., :3].astype(float)


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def reached(session, time):
    """Wait until a session has come to a time [s]."""
    until(lambda: session.snapshot.health.time > time)
