import pytest

from service.mapper.background import BackgroundJobs, Done, InlineWorker, WorkLostError


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


def test_after_lost_work_no_batch_is_submitted():
    worker = LosesTheSecond(Echo())
    jobs = BackgroundJobs(worker)
    for k in range(3):
        jobs.submit(k)
    assert jobs.take() == 0
    with pytest.raises(WorkLostError):
        jobs.take()
    assert (jobs.fault, jobs.waiting) == ("the process died", 0)
    jobs.submit(4)
    assert worker.submitted == 3
