"""Executors that show, in this process, what another process would see."""

import pickle
from concurrent.futures import Executor, Future


class Pickled(Executor):
    """Work and results go through pickle, as to another process and back; `count` of them did."""

    def __init__(self):
        self.count = 0

    def submit(self, fn, /, *args, **kwargs):
        self.count += 1
        fn, args, kwargs = pickle.loads(pickle.dumps((fn, args, kwargs)))
        future = Future()
        try:
            future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))
        except Exception as error:
            future.set_exception(pickle.loads(pickle.dumps(error)))
        return future
