//! A command that was given to the bus, with the receivers of its answer and its confirmation.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::order::{Answer, Outcome, joined};

/// Effect of an acknowledged command as shown by reads; empty for any other.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Shown {
    /// Time from acceptance to the read that showed the effect.
    pub after: Option<Duration>,
    /// Why no read can show the effect of the command.
    pub unseen: Option<String>,
}

/// A command that is in the queue of its bus, or was answered already. No runtime is needed: a task waits with
/// [`Placed::answered`], other callers poll with [`Placed::answer`]. Dropping it does not cancel the command.
#[derive(Debug)]
pub struct Placed {
    accepted: Instant,
    /// Answer to the command, or to its stop if it also does more.
    answer: Arriving<Answer>,
    confirmation: Arriving<Result<Duration, String>>,
    rest: Option<Box<Rest>>,
}

/// The pending results of the rest of a command.
#[derive(Debug)]
struct Rest {
    answer: Arriving<Answer>,
    confirmation: Arriving<Result<Duration, String>>,
}

impl Placed {
    pub(super) fn new(
        accepted: Instant,
        answer: oneshot::Receiver<Answer>,
        confirmation: oneshot::Receiver<Result<Duration, String>>,
    ) -> Placed {
        Placed {
            accepted,
            answer: Arriving::Awaited(answer),
            confirmation: Arriving::Awaited(confirmation),
            rest: None,
        }
    }

    /// Adds the rest of a command that was split into stop and rest: one result covers both parts.
    pub(super) fn with_rest(
        mut self,
        answer: oneshot::Receiver<Answer>,
        confirmation: oneshot::Receiver<Result<Duration, String>>,
    ) -> Placed {
        self.rest = Some(Box::new(Rest {
            answer: Arriving::Awaited(answer),
            confirmation: Arriving::Awaited(confirmation),
        }));
        self
    }

    /// When the order was accepted.
    pub fn accepted(&self) -> Instant {
        self.accepted
    }

    /// The answer, if it has arrived.
    pub fn answer(&mut self) -> Option<Answer> {
        now(|cx| self.poll_answer(cx))
    }

    /// Waits for the single answer to the command.
    pub async fn answered(&mut self) -> Answer {
        poll_fn(|cx| self.poll_answer(cx)).await
    }

    /// Polls for the answer, like [`Placed::answered`], for callers that wait for several things.
    pub fn poll_answer(&mut self, cx: &mut Context<'_>) -> Poll<Answer> {
        let stop = answer_of(&mut self.answer, cx);
        let Some(rest) = &mut self.rest else { return stop };
        let rest = answer_of(&mut rest.answer, cx);
        let latency = |part: &Poll<Answer>| match part {
            Poll::Ready(answer) => answer.latency,
            Poll::Pending => Duration::ZERO,
        };
        let latency = latency(&stop).max(latency(&rest));
        let outcome = |part: Poll<Answer>| match part {
            Poll::Ready(answer) => Some(answer.outcome),
            Poll::Pending => None,
        };
        match joined(outcome(stop), outcome(rest)) {
            Some(outcome) => Poll::Ready(Answer { outcome, latency }),
            None => Poll::Pending,
        }
    }

    /// Waits for the read that shows the effect: returns the time from acceptance to that read, or `None` if the
    /// order was refused or no read showed the effect within the profile's time.
    pub async fn confirmed(&mut self) -> Option<Duration> {
        if self.answered().await.outcome.is_ok() {
            poll_fn(|cx| self.poll_confirmation(cx)).await
        } else {
            None
        }
    }

    /// What is known of the effect so far.
    pub fn shown(&mut self) -> Shown {
        let stop = now(|cx| self.confirmation.poll(cx)).flatten();
        let seen = match &mut self.rest {
            Some(rest) => match (stop, now(|cx| rest.confirmation.poll(cx)).flatten()) {
                (Some(Ok(stop)), Some(Ok(rest))) => Some(Ok(stop.max(rest))),
                (Some(Err(why)), _) | (_, Some(Err(why))) => Some(Err(why)),
                _ => None,
            },
            None => stop,
        };
        match seen {
            Some(Ok(after)) => Shown {
                after: Some(after),
                unseen: None,
            },
            Some(Err(why)) => Shown {
                after: None,
                unseen: Some(why),
            },
            None => Shown::default(),
        }
    }

    /// Polls for the confirmation, like [`Placed::confirmed`], for callers that wait for several things.
    pub fn poll_confirmation(&mut self, cx: &mut Context<'_>) -> Poll<Option<Duration>> {
        let stop = self.confirmation.poll(cx).map(|seen| seen.and_then(Result::ok));
        let Some(rest) = &mut self.rest else { return stop };
        match (stop, rest.confirmation.poll(cx).map(|seen| seen.and_then(Result::ok))) {
            (Poll::Ready(stop), Poll::Ready(rest)) => Poll::Ready(stop.zip(rest).map(|(stop, rest)| stop.max(rest))),
            _ => Poll::Pending,
        }
    }
}

fn answer_of(arriving: &mut Arriving<Answer>, cx: &mut Context<'_>) -> Poll<Answer> {
    arriving.poll(cx).map(|answer| {
        // A dropped ticket answers too, so a closed channel can only mean that the process ends.
        answer.unwrap_or(Answer {
            outcome: Outcome::ShuttingDown,
            latency: Duration::ZERO,
        })
    })
}

/// A value that arrives once and can be read repeatedly.
#[derive(Debug)]
enum Arriving<T> {
    Awaited(oneshot::Receiver<T>),
    /// The result has arrived; `None` means that there will never be one.
    Known(Option<T>),
}

impl<T: Clone> Arriving<T> {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Option<T>> {
        if let Arriving::Awaited(receiver) = self {
            match Pin::new(receiver).poll(cx) {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(value) => *self = Arriving::Known(value.ok()),
            }
        }
        match self {
            Arriving::Known(value) => Poll::Ready(value.clone()),
            Arriving::Awaited(_) => Poll::Pending,
        }
    }
}

/// The result of a poll without waiting.
fn now<T>(poll: impl FnOnce(&mut Context<'_>) -> Poll<T>) -> Option<T> {
    match poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(ready) => Some(ready),
        Poll::Pending => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::Reply;

    #[test]
    fn asked_without_a_runtime_and_as_often_as_one_likes() {
        let (sender, answer) = oneshot::channel();
        let (confirm, confirmation) = oneshot::channel();
        let mut placed = Placed::new(Instant::now(), answer, confirmation);
        let settled = |placed: &mut Placed| now(|cx| placed.poll_confirmation(cx));
        assert_eq!((placed.answer(), settled(&mut placed)), (None, None));
        let acknowledged = Answer {
            outcome: Outcome::Acknowledged(Reply::Written),
            latency: Duration::from_millis(3),
        };
        sender.send(acknowledged.clone()).unwrap();
        assert_eq!(placed.answer().as_ref(), Some(&acknowledged));
        assert_eq!(placed.answer(), Some(acknowledged));
        assert_eq!(settled(&mut placed), None);
        confirm.send(Ok(Duration::from_millis(9))).unwrap();
        let confirmed = Some(Some(Duration::from_millis(9)));
        assert_eq!((settled(&mut placed), settled(&mut placed)), (confirmed, confirmed));
        assert_eq!(placed.shown().after, Some(Duration::from_millis(9)));
        let (confirm, confirmation) = oneshot::channel();
        let mut placed = Placed::new(Instant::now(), oneshot::channel().1, confirmation);
        confirm.send(Err("the bypass is on".to_string())).unwrap();
        assert_eq!(settled(&mut placed), Some(None));
        assert_eq!(placed.shown().unseen.as_deref(), Some("the bypass is on"));
    }

    #[test]
    fn a_sender_that_is_gone_is_an_answer_too() {
        let mut placed = Placed::new(Instant::now(), oneshot::channel().1, oneshot::channel().1);
        assert_eq!(placed.answer().unwrap().outcome, Outcome::ShuttingDown);
        assert_eq!(now(|cx| placed.poll_confirmation(cx)), Some(None));
    }
}
