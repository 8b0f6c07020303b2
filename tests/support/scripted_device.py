"""A device whose thread executes a script: send bytes, wait, break the link."""

import threading

from jaxsonar.hardware.transport_servers import listen

NEVER = threading.Event()


class ScriptedDevice:
    """A sink with a thread that sends messages."""

    def __init__(self, url):
        self.sink = listen(url)
        self.url = self.sink.url
        self.stop = threading.Event()
        self.thread = None

    def run(self, *steps):
        """Bytes are sent; the thread waits for numbers (seconds) and events; names are methods of the sink to call."""

        def work():
            for step in steps:
                if isinstance(step, bytes):
                    while not self.sink.send(step, self.stop):
                        if not self.sink.wait_client(self.stop):
                            return
                elif isinstance(step, str):
                    getattr(self.sink, step)()
                elif isinstance(step, threading.Event):
                    step.wait(20)
                else:
                    self.stop.wait(step)

        self.thread = threading.Thread(target=work)
        self.thread.start()

    def finish(self):
        if self.thread is not None:
            self.thread.join(20)
            assert not self.thread.is_alive()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop.set()
        self.finish()
        self.sink.close()
