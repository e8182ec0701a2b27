//! Lists of addresses on the command line.

/// Addresses of drives in ascending order, without duplicates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Addresses(pub(super) Vec<u8>);

pub(super) fn parse_addresses(text: &str) -> Result<Addresses, String> {
    let bad = || {
        format!(
            "`{text}` is not a list of addresses; write numbers from 1 to 247, with N2 from 1 to 255, such as 1-10 or 1,2,7"
        )
    };
    let number = |word: &str| word.trim().parse::<u8>().ok().filter(|n| *n >= 1).ok_or_else(bad);
    let mut addresses = Vec::new();
    for part in text.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last) = (number(first)?, number(last)?);
        if first > last {
            return Err(bad());
        }
        addresses.extend(first..=last);
    }
    addresses.sort_unstable();
    addresses.dedup();
    Ok(Addresses(addresses))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        assert_eq!(parse_addresses("3,1-2,2").unwrap().0, [1, 2, 3]);
        assert_eq!(parse_addresses("247").unwrap().0, [247]);
        assert_eq!(
            parse_addresses("248-255").unwrap().0,
            [248, 249, 250, 251, 252, 253, 254, 255]
        );
        for bad in ["", "0", "256", "5-1", "1-", "x", "1,,2"] {
            assert!(parse_addresses(bad).is_err(), "{bad}");
        }
    }
}
