"""Kernels are compiled before the first step, which does not launch them."""

# pyright: reportIndexIssue=false
import warp as wp
from palpate.batch.mjw.compiling import compile_ahead


@wp.kernel(enable_backward=False)
def _count(out: wp.array[int]):
  out[wp.tid()] = out[wp.tid()] + 1


def test_kernels_are_compiled_before_they_are_launched():
  launched, asked = wp.launch, wp.get_suggested_block_size
  out = wp.zeros(3, dtype=int, device="cpu")
  more = wp.ones(1, dtype=int, device="cpu")

  def work():
    wp.launch(_count, dim=3, inputs=[out], device="cpu")

  def works():
    wp.get_suggested_block_size(_count)  # would compile it, on CUDA
    wp.capture_while(more, while_body=work)  # would not end

  compile_ahead(wp.get_device("cpu"), [works])
  assert out.numpy().tolist() == [0, 0, 0]
  assert wp.launch is launched and wp.get_suggested_block_size is asked
  work()
  assert out.numpy().tolist() == [1, 1, 1]
