import pytest

from service.mapper.background import Done, Errand, InlineWorker, WorkLostError


class Echo:
    def work(self, batch: object) -> object:
        return batch


class Lost(Done):
    def result(self) -> object:
        raise WorkLostError("the process died")


class LosesTheSecond(InlineWorker):
    submitted = 0

    def submit(self, batch: object) -> Done:
        self.submitted += 1
        return Lost(None) if self.submitted == 2 else super().submit(batch)


def test_what_goes_out_comes_back_in_order():
    errand = Errand(InlineWorker(Echo()))
    assert not errand.ready
    for k in range(3):
        errand.submit(k)
    assert (errand.waiting, errand.ready) == (3, True)
    assert [errand.take() for _ in range(3)] == [0, 1, 2]
    assert errand.waiting == 0


def test_after_a_loss_nothing_goes_out_any_more():
    worker = LosesTheSecond(Echo())
    errand = Errand(worker)
    for k in range(3):
        errand.submit(k)
    assert errand.take() == 0
    with pytest.raises(WorkLostError):
        errand.take()
    assert (errand.trouble, errand.waiting) == ("the process died", 0)
    errand.submit(4)
    assert worker.submitted == 3
