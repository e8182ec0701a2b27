//! The number of a message that waits for the broker: the same on disk, in the store and in the outbox.

/// Number of an event or of history among the messages of its kind, ascending from 1 in the order in which they are sent.
/// The log has given numbers when the gateway starts, so those of this run follow those on disk.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct MessageNumber(u64);

impl MessageNumber {
    /// Precedes the first message.
    pub(super) const NONE: MessageNumber = MessageNumber(0);

    /// A number as it is in a record.
    pub(super) const fn new(number: u64) -> MessageNumber {
        MessageNumber(number)
    }

    pub(super) const fn get(self) -> u64 {
        self.0
    }

    /// The number of the message after this one.
    pub(super) const fn next(self) -> MessageNumber {
        self.plus(1)
    }

    /// The number of the message before this one; nothing precedes [`MessageNumber::NONE`].
    pub(super) const fn previous(self) -> MessageNumber {
        MessageNumber(self.0.saturating_sub(1))
    }

    /// The number of the last of so many messages after this one.
    pub(super) const fn plus(self, count: u64) -> MessageNumber {
        MessageNumber(self.0.saturating_add(count))
    }

    /// How many messages follow `earlier`, up to this one; none if it is the later one.
    pub(super) const fn since(self, earlier: MessageNumber) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// Place of a message in its queue of the outbox. A message that the log keeps has its number; any other, such as a
/// result, is counted after the last message with a number.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Place {
    number: MessageNumber,
    /// Position among the messages without a number that follow the one with `number`; 0 for that one.
    unkept: u64,
}

impl Place {
    /// The place of the message after this one, with its number if the log keeps it.
    pub(super) fn next(self, number: Option<MessageNumber>) -> Place {
        match number {
            Some(number) => Place { number, unkept: 0 },
            None => Place {
                unkept: self.unkept.saturating_add(1),
                ..self
            },
        }
    }

    /// Number of the message, if the log keeps it.
    pub(super) fn number(self) -> Option<MessageNumber> {
        (self.unkept == 0).then_some(self.number)
    }

    /// Whether the place precedes every message after `through`.
    pub(super) fn is_within(self, through: MessageNumber) -> bool {
        self.number <= through
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_ascend_with_and_without_a_number() {
        let (seven, nine) = (MessageNumber::new(7), MessageNumber::new(9));
        let mut place = Place::default();
        let mut places = Vec::new();
        for number in [None, None, Some(seven), None, None, Some(nine)] {
            place = place.next(number);
            assert_eq!(place.number(), number);
            places.push(place);
        }
        assert!(places.is_sorted_by(|a, b| a < b), "{places:?}");
        let within = places.iter().filter(|place| place.is_within(seven));
        assert_eq!(within.count(), 5);
    }

    #[test]
    fn numbers_stay_within_their_range() {
        let (first, last) = (MessageNumber::NONE.next(), MessageNumber::new(u64::MAX));
        assert_eq!((first.get(), first.previous()), (1, MessageNumber::NONE));
        assert_eq!(
            (MessageNumber::NONE.previous(), last.next()),
            (MessageNumber::NONE, last)
        );
        assert_eq!(first.plus(4).since(first), 4);
        assert_eq!(first.since(first.plus(4)), 0);
    }
}
