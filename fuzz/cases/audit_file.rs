//! An audit file in any state in which a crash or a person may have left it.
//!
//! Input: the audit file.

use std::time::SystemTime;

use drivegate_core::order::chain::{Chain, Entry, Verifier, fragment, tail};

fn is_whole(text: &[u8]) -> Option<Option<Chain>> {
    let mut verifier = Verifier::new(None);
    let lines = text.strip_suffix(b"\n").filter(|text| !text.is_empty())?;
    let mut whole = true;
    for line in lines.split(|byte| *byte == b'\n') {
        whole &= verifier.line(line).is_ok();
    }
    (whole && verifier.finish().is_ok()).then_some(verifier.chain())
}

pub(crate) fn run(data: &[u8]) {
    let was_whole = is_whole(data);
    let Some(end) = tail(data, true) else {
        assert!(was_whole.is_none());
        return;
    };
    if let Some(chain) = was_whole {
        assert_eq!((end.chain, end.fragment, end.ended), (chain.unwrap_or_default(), None, true));
    }
    // Repairs the file as the gateway does when it starts.
    let mut repaired = data.to_vec();
    if !end.ended {
        repaired.push(b'\n');
    }
    let mut chain = end.chain;
    if chain.seq == u64::MAX {
        return;
    }
    let time = SystemTime::UNIX_EPOCH;
    if let Some((bytes, sha256)) = end.fragment {
        let (line, after) = chain.line(&Entry::Fragment { time, bytes, sha256 }).unwrap();
        repaired.extend(line);
        chain = after;
    }
    if chain.seq < u64::MAX {
        let entry = Entry::Lost {
            time,
            sent: 1,
            not_sent: 2,
        };
        let (line, after) = chain.line(&entry).unwrap();
        repaired.extend(line);
        chain = after;
    }
    let again = tail(&repaired, true).expect("there is an entry");
    assert_eq!((again.chain, again.fragment, again.ended), (chain, None, true));
    if was_whole.is_some() {
        assert_eq!(is_whole(&repaired), Some(Some(chain)), "the chain goes on");
    }
    let _ = fragment(data);
}
