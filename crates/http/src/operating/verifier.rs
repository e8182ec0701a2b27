//! Compares passwords with their hashes: one at a time, on a separate thread with low priority, so that no number
//! of logins delays users who are logged in.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

use super::super::users::Workspace;

/// Maximum number of passwords that wait to be verified.
const MOST_WAITING: usize = 16;
/// Maximum number of waiting passwords from one address.
const MOST_OF_ADDRESS: usize = 4;
/// Niceness of the thread.
const NICE: i32 = 10;

/// A password that waits to be verified.
#[derive(Debug)]
struct Waiting {
    /// Failures of the source of this attempt: sources with fewer are served first, and are not displaced by those
    /// with more.
    failures: u32,
    number: u64,
    address: IpAddr,
    /// Hash of the user, if the user exists.
    hash: Option<String>,
    /// Hashes of other passwords, computed only so that a check always takes equally long.
    others: Vec<String>,
    password: String,
    answer: oneshot::Sender<bool>,
}

impl Waiting {
    /// Computes all hashes in any case, so that the time does not depend on the result.
    fn is_right(&self, workspace: &mut Workspace) -> bool {
        for other in &self.others {
            let _ = std::hint::black_box(workspace.is_password(other, &self.password));
        }
        let own = self.hash.as_ref();
        own.is_some_and(|hash| workspace.is_password(hash, &self.password))
    }
}

#[derive(Debug, Default)]
struct Queue {
    waiting: Vec<Waiting>,
    numbered: u64,
    /// Whether a thread processes the queue.
    served: bool,
    /// The working memory, while no thread runs.
    workspace: Workspace,
}

impl Queue {
    /// Adds a password, possibly in place of another one, which then gets no answer. Returns whether it was added.
    fn push(&mut self, mut new: Waiting) -> bool {
        self.waiting.retain(|waiting| !waiting.answer.is_closed());
        self.numbered += 1;
        new.number = self.numbered;
        let of_address = self.waiting.iter().filter(|waiting| waiting.address == new.address);
        let full = self.waiting.len() >= MOST_WAITING;
        if full || of_address.count() >= MOST_OF_ADDRESS {
            let worst = (0..self.waiting.len())
                .filter_map(|index| Some((index, self.waiting.get(index)?)))
                .filter(|(_, waiting)| full || waiting.address == new.address)
                .max_by_key(|(_, waiting)| (waiting.failures, waiting.number));
            match worst {
                Some((index, worst)) if worst.failures > new.failures => drop(self.waiting.remove(index)),
                _ => return false,
            }
        }
        self.waiting.push(new);
        true
    }

    /// The next password: among those with the fewest failures, the one that arrived first.
    fn next(&mut self) -> Option<Waiting> {
        let first = (0..self.waiting.len()).min_by_key(|index| {
            let waiting = self.waiting.get(*index);
            waiting.map(|waiting| (waiting.failures, waiting.number))
        })?;
        Some(self.waiting.remove(first))
    }
}

/// Verifies passwords on its thread.
#[derive(Debug, Default, Clone)]
pub(super) struct Verifier(Arc<Mutex<Queue>>);

impl Verifier {
    /// Whether the password matches the first hash; the others are always computed as well. `None` if too many
    /// passwords wait, or others take precedence.
    pub(super) async fn verify(
        &self,
        (hash, others): (Option<&str>, Vec<String>),
        password: &str,
        address: IpAddr,
        failures: u32,
    ) -> Option<bool> {
        let (answer, answered) = oneshot::channel();
        let waiting = Waiting {
            failures,
            number: 0,
            address,
            hash: hash.map(str::to_string),
            others,
            password: password.to_string(),
            answer,
        };
        {
            let mut queue = self.lock();
            if !queue.push(waiting) {
                return None;
            }
            // The thread ends when nothing waits, so an idle gateway has no such thread.
            if !queue.served {
                let own = self.clone();
                let thread = std::thread::Builder::new().name("logins".to_string());
                queue.served = thread.spawn(move || own.serve()).is_ok();
                if !queue.served {
                    queue.waiting.clear();
                }
            }
        }
        answered.await.ok()
    }

    fn serve(&self) {
        // If the priority cannot be lowered, the thread runs with normal priority.
        let _ = rustix::process::nice(NICE);
        let mut workspace = std::mem::take(&mut self.lock().workspace);
        loop {
            let next = {
                let mut queue = self.lock();
                let next = queue.next();
                queue.served = next.is_some();
                if next.is_none() {
                    queue.workspace = std::mem::take(&mut workspace);
                }
                next
            };
            let Some(next) = next else { return };
            if !next.answer.is_closed() {
                let is_right = next.is_right(&mut workspace);
                // The client may have disconnected, so an error is ignored.
                let _ = next.answer.send(is_right);
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waiting(address: u8, failures: u32) -> (Waiting, oneshot::Receiver<bool>) {
        let (answer, answered) = oneshot::channel();
        let waiting = Waiting {
            failures,
            number: 0,
            address: [192, 0, 2, address].into(),
            hash: None,
            others: Vec::new(),
            password: String::new(),
            answer,
        };
        (waiting, answered)
    }

    #[test]
    fn who_failed_yields_to_who_did_not() {
        let mut queue = Queue::default();
        let mut kept = Vec::new();
        for number in 0..100 {
            let (one, answered) = waiting(number % 20, 3);
            if queue.push(one) {
                kept.push(answered);
            }
        }
        assert_eq!(queue.waiting.len(), MOST_WAITING);
        let (operator, mut answered) = waiting(200, 0);
        assert!(queue.push(operator), "a full queue does not keep the operator out");
        assert_eq!(queue.waiting.len(), MOST_WAITING);
        let next = queue.next().unwrap();
        assert_eq!(
            (next.failures, next.address),
            (0, [192, 0, 2, 200].into()),
            "and it goes first"
        );
        next.answer.send(true).unwrap();
        assert_eq!(answered.try_recv(), Ok(true));
        assert_eq!(
            queue.next().unwrap().address,
            IpAddr::from([192, 0, 2, 0]),
            "then the first"
        );
    }

    #[test]
    fn an_address_has_few_places_and_who_has_gone_has_none() {
        let mut queue = Queue::default();
        let pushed: Vec<_> = (0..10).map(|_| waiting(1, 0)).collect();
        let (ones, answered): (Vec<_>, Vec<_>) = pushed.into_iter().unzip();
        assert_eq!(
            ones.into_iter().filter_map(|one| queue.push(one).then_some(())).count(),
            MOST_OF_ADDRESS
        );
        let (other, _answered) = waiting(2, 9);
        assert!(queue.push(other));
        drop(answered);
        let (again, _answered_again) = waiting(1, 0);
        assert!(queue.push(again));
        assert_eq!(queue.waiting.len(), 2);
    }

    #[tokio::test]
    async fn passwords_are_compared_and_the_thread_ends() {
        let verifier = Verifier::default();
        let user = crate::User::new("alice", "correct horse").unwrap();
        let (address, hashes) = ([192, 0, 2, 1].into(), || (Some(user.hash()), Vec::new()));
        let right = verifier.verify(hashes(), "correct horse", address, 0);
        let wrong = verifier.verify(hashes(), "wrong horse", address, 0);
        assert_eq!(tokio::join!(right, wrong), (Some(true), Some(false)));
        while verifier.lock().served {
            tokio::task::yield_now().await;
        }
        assert_eq!(verifier.verify(hashes(), "correct horse", address, 0).await, Some(true));
    }
}
