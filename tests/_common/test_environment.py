"""The surroundings of a fit: double precision, one thread of linear algebra, everything as before
afterwards."""

import contextlib

import jax
import numpy as np
import pytest
import threadpoolctl

from jaxmuscle._common.environment import fitting


def threads():
    np.linalg.inv(np.eye(2))
    return [
        one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"
    ]


def test_linear_algebra_has_one_thread_until_the_last_fit_has_ended():
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads()
        assert set(before) == {2}
        first, second = contextlib.ExitStack(), contextlib.ExitStack()
        first.enter_context(fitting())
        second.enter_context(fitting())
        assert set(threads()) == {1} and jax.config.jax_enable_x64
        second.close()
        assert set(threads()) == {1}
        first.close()
        assert threads() == before and not jax.config.jax_enable_x64


def test_after_an_error_all_is_as_before():
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        with pytest.raises(RuntimeError, match="stop"), fitting():
            raise RuntimeError("stop")
        assert set(threads()) == {2} and not jax.config.jax_enable_x64
