//! Telnet as far as RFC 2217 needs it: data and commands in one stream of bytes (RFC 854, 855).

/// "Interpret as command"; two such bytes represent the byte 255.
pub(super) const IAC: u8 = 255;
pub(super) const SE: u8 = 240;
pub(super) const SB: u8 = 250;

/// Longest content of a subnegotiation that is kept: those of RFC 2217 have five bytes, except the signature.
const MOST_SUB: usize = 64;

/// Answer of one end about an option.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verb {
    Will,
    Wont,
    Do,
    Dont,
}

impl Verb {
    pub(super) const fn byte(self) -> u8 {
        match self {
            Verb::Will => 251,
            Verb::Wont => 252,
            Verb::Do => 253,
            Verb::Dont => 254,
        }
    }

    const fn of(byte: u8) -> Option<Verb> {
        match byte {
            251 => Some(Verb::Will),
            252 => Some(Verb::Wont),
            253 => Some(Verb::Do),
            254 => Some(Verb::Dont),
            _ => None,
        }
    }
}

/// Anything that the other end sends apart from data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Command {
    /// A verb about an option.
    Option(Verb, u8),
    /// A subnegotiation: the option, followed by the content. One that is longer than [`MOST_SUB`] is ignored.
    Sub(Vec<u8>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum State {
    #[default]
    Data,
    /// The byte after IAC is expected.
    Command,
    Option(Verb),
    Sub,
    /// The byte after an IAC within a subnegotiation is expected.
    SubCommand,
}

/// Separates data and commands of a stream that arrives in pieces of any size.
#[derive(Debug, Default)]
pub(super) struct Decoder {
    state: State,
    sub: Vec<u8>,
    /// The subnegotiation is longer than is kept.
    too_long: bool,
}

impl Decoder {
    /// Appends the data in `bytes` to `data` and the commands to `commands`.
    pub(super) fn take(&mut self, bytes: &[u8], data: &mut Vec<u8>, commands: &mut Vec<Command>) {
        for &byte in bytes {
            self.state = match (self.state, byte) {
                (State::Data, IAC) => State::Command,
                (State::Data, _) => {
                    data.push(byte);
                    State::Data
                }
                (State::Command, IAC) => {
                    data.push(IAC);
                    State::Data
                }
                (State::Command | State::SubCommand, SB) => {
                    self.sub.clear();
                    self.too_long = false;
                    State::Sub
                }
                // Commands without content (NOP, break, go ahead ...) have no meaning here.
                (State::Command, _) => Verb::of(byte).map_or(State::Data, State::Option),
                (State::Option(verb), _) => {
                    commands.push(Command::Option(verb, byte));
                    State::Data
                }
                (State::Sub, IAC) => State::SubCommand,
                (State::Sub, _) | (State::SubCommand, IAC) => {
                    self.too_long |= self.sub.len() >= MOST_SUB;
                    if !self.too_long {
                        self.sub.push(byte);
                    }
                    State::Sub
                }
                (State::SubCommand, SE) => {
                    let sub = std::mem::take(&mut self.sub);
                    if !self.too_long && !sub.is_empty() {
                        commands.push(Command::Sub(sub));
                    }
                    State::Data
                }
                // Any other command ends a subnegotiation whose end is missing.
                (State::SubCommand, _) => Verb::of(byte).map_or(State::Data, State::Option),
            };
        }
    }
}

/// Data in the form in which it is sent: each byte 255 is doubled.
pub fn escape(data: &[u8]) -> Vec<u8> {
    let mut escaped = Vec::with_capacity(data.len() + 4);
    for &byte in data {
        escaped.push(byte);
        if byte == IAC {
            escaped.push(IAC);
        }
    }
    escaped
}

/// Whether the first bytes of a connection come from a telnet server: an option that it offers or requests. No
/// frame of any protocol begins with 255. `None` while that is undecided.
pub(crate) fn is_greeting(first: &[u8]) -> Option<bool> {
    match first {
        [] | [IAC] => None,
        [IAC, second, rest @ ..] if Verb::of(*second).is_some() => (!rest.is_empty()).then_some(true),
        _ => Some(false),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn decoded(pieces: &[&[u8]]) -> (Vec<u8>, Vec<Command>) {
        let (mut decoder, mut data, mut commands) = (Decoder::default(), Vec::new(), Vec::new());
        for piece in pieces {
            decoder.take(piece, &mut data, &mut commands);
        }
        (data, commands)
    }

    #[test]
    fn data_and_commands_are_told_apart() {
        let stream = [
            1, IAC, IAC, 2, IAC, 253, 44, 3, IAC, SB, 44, 101, 0, 0, IAC, IAC, 0, IAC, SE, 4, IAC, 241, 5,
        ];
        let expected = (
            vec![1, 255, 2, 3, 4, 5],
            vec![Command::Option(Verb::Do, 44), Command::Sub(vec![44, 101, 0, 0, 255, 0])],
        );
        assert_eq!(decoded(&[&stream]), expected);
        let bytes: Vec<&[u8]> = stream.chunks(1).collect();
        assert_eq!(decoded(&bytes), expected, "byte by byte");
    }

    #[test]
    fn a_subnegotiation_without_end_holds_nothing_up() {
        let long = [[IAC, SB, 44].as_slice(), &[7; 500], &[IAC, SE, 9]].concat();
        assert_eq!(decoded(&[&long]), (vec![9], vec![]));
        let cut = [IAC, SB, 44, 1, IAC, 251, 1, 9];
        assert_eq!(decoded(&[&cut]), (vec![9], vec![Command::Option(Verb::Will, 1)]));
        assert_eq!(decoded(&[&[IAC, SB, IAC, SE, 9]]), (vec![9], vec![]));
        let anew = [IAC, SB, 44, 1, IAC, SB, 44, 2, IAC, SE];
        assert_eq!(decoded(&[&anew]), (vec![], vec![Command::Sub(vec![44, 2])]));
    }

    #[test]
    fn a_greeting_is_told_from_frames() {
        for greeting in [&[IAC, 253, 44][..], &[IAC, 251, 1, 9, 9]] {
            assert_eq!(is_greeting(greeting), Some(true));
        }
        for open in [&[][..], &[IAC], &[IAC, 254]] {
            assert_eq!(is_greeting(open), None);
        }
        for frame in [&[1, 3, 2][..], b":01", b">", &[IAC, IAC], &[IAC, 3, 2]] {
            assert_eq!(is_greeting(frame), Some(false));
        }
    }

    proptest! {
        #[test]
        fn what_is_escaped_is_the_same_when_decoded(data: Vec<u8>, at: usize) {
            let escaped = escape(&data);
            let (first, second) = escaped.split_at(at % (escaped.len() + 1));
            prop_assert_eq!(decoded(&[first, second]), (data, vec![]));
        }

        #[test]
        fn pieces_make_no_difference_and_nothing_grows(
            stream in prop::collection::vec(prop_oneof![Just(IAC), Just(SB), Just(SE), Just(44u8), 250..=255u8, any::<u8>()], 0..600),
            size in 1..20usize,
        ) {
            let whole = decoded(&[&stream]);
            let pieces: Vec<&[u8]> = stream.chunks(size).collect();
            prop_assert_eq!(&decoded(&pieces), &whole);
            prop_assert!(whole.0.len() <= stream.len());
            for command in &whole.1 {
                if let Command::Sub(content) = command {
                    prop_assert!((1..=MOST_SUB).contains(&content.len()));
                }
            }
        }
    }
}
