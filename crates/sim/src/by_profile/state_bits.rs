//! Bits of registers that must show several states at the same time. Pure.

use std::collections::BTreeMap;

use drivegate_model::drive::profile::Part;
use drivegate_proto::Table;

/// A register, or an item of a bit table.
pub(super) type Key = (Table, u16);

/// Bits in registers that together represent one state.
pub(super) type Bits = Vec<(Key, Part)>;

/// A state that any of these bits represent must be on, or off.
#[derive(Debug, Clone)]
pub(super) struct Wish {
    pub(super) any: Vec<Bits>,
    pub(super) want: bool,
}

/// Maximum number of nodes of a search for bits; no profile has that many states in one register.
const MOST_TRIES: usize = 4000;
/// Maximum number of ways to keep a state off that the search follows.
const MOST_WAYS: usize = 24;

/// Bits whose values are fixed already.
type Fixed = BTreeMap<Key, Part>;

/// Bits that satisfy the wishes; an earlier wish takes precedence over later ones that contradict it. Bits with a
/// free choice keep their value from `base`.
pub(super) fn fulfilled(wishes: &[Wish], base: impl Fn(Key) -> u16) -> Fixed {
    let mut fixed = Fixed::new();
    let mut taken: Vec<&Wish> = Vec::new();
    for wish in wishes {
        let next = match ways(&fixed, wish, &base).into_iter().next() {
            Some(next) => Some(next),
            None => {
                let all: Vec<&Wish> = taken.iter().copied().chain([wish]).collect();
                search(&Fixed::new(), &all, &base, &mut MOST_TRIES.clone())
            }
        };
        if let Some(next) = next {
            fixed = next;
            taken.push(wish);
        }
    }
    fixed
}

fn search(fixed: &Fixed, wishes: &[&Wish], base: &impl Fn(Key) -> u16, tries: &mut usize) -> Option<Fixed> {
    let Some((first, rest)) = wishes.split_first() else {
        return Some(fixed.clone());
    };
    *tries = tries.checked_sub(1)?;
    let mut all = ways(fixed, first, base).into_iter();
    all.find_map(|way| search(&way, rest, base, tries))
}

/// Every way to satisfy a wish in addition to what is fixed, those that change least of `base` first.
fn ways(fixed: &Fixed, wish: &Wish, base: &impl Fn(Key) -> u16) -> Vec<Fixed> {
    if wish.want {
        let mut ways: Vec<Fixed> = wish.any.iter().filter_map(|bits| with(fixed, bits)).collect();
        ways.sort_by_key(|way| changes(way, base));
        ways
    } else {
        wish.any.iter().fold(vec![fixed.clone()], |ways, bits| {
            let mut next: Vec<Fixed> = ways.iter().flat_map(|way| without(way, bits)).collect();
            next.sort_by_key(|way| changes(way, base));
            next.truncate(MOST_WAYS);
            next
        })
    }
}

fn changes(fixed: &Fixed, base: &impl Fn(Key) -> u16) -> u32 {
    let changed = |(key, part): (&Key, &Part)| ((base(*key) ^ part.value) & part.mask).count_ones();
    fixed.iter().map(changed).sum()
}

fn with(fixed: &Fixed, bits: &Bits) -> Option<Fixed> {
    let mut next = fixed.clone();
    for (key, part) in bits {
        let known = next.entry(*key).or_insert(Part { mask: 0, value: 0 });
        if (known.value ^ part.value) & known.mask & part.mask != 0 {
            return None;
        }
        known.mask |= part.mask;
        known.value |= part.value & part.mask;
    }
    Some(next)
}

/// Ways in which at least one of these bits has the opposite value.
fn without(fixed: &Fixed, bits: &Bits) -> Vec<Fixed> {
    if with(fixed, bits).is_none() {
        return vec![fixed.clone()];
    }
    let mut ways = Vec::new();
    for (key, part) in bits {
        let known = fixed.get(key).map_or(0, |known| known.mask);
        for bit in (0..16)
            .map(|bit| 1u16 << bit)
            .filter(|bit| part.mask & !known & bit != 0)
        {
            let other = Part {
                mask: bit,
                value: !part.value & bit,
            };
            ways.extend(with(fixed, &vec![(*key, other)]));
        }
    }
    ways
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORD: Key = (Table::Holding, 3);

    fn is(mask: u16, value: u16) -> Bits {
        vec![(WORD, Part { mask, value })]
    }

    fn word(wishes: &[(bool, &[(u16, u16)])]) -> u16 {
        let wishes: Vec<Wish> = wishes
            .iter()
            .map(|(want, any)| Wish {
                any: any.iter().map(|(mask, value)| is(*mask, *value)).collect(),
                want: *want,
            })
            .collect();
        fulfilled(&wishes, |_| 0).get(&WORD).map_or(0, |part| part.value)
    }

    /// Status words of a CiA 402 drive and of an ABB drive, worked out by hand.
    #[test]
    fn words_show_all_states_at_once() {
        let ready: &[(u16, u16)] = &[(0x6F, 0x21), (0x6F, 0x23), (0x4F, 0x40)];
        let running: &[(u16, u16)] = &[(0x6F, 0x27)];
        let fault: &[(u16, u16)] = &[(0x4F, 0x08)];
        let remote: &[(u16, u16)] = &[(0x200, 0x200)];
        let idle = word(&[
            (false, fault),
            (false, running),
            (false, &[(0x6F, 0x21)]),
            (true, ready),
            (true, remote),
        ]);
        assert!(idle & 0x4F == 0x40 || idle & 0x6F == 0x23, "{idle:#x}");
        let runs = word(&[(false, fault), (true, running), (true, ready), (true, remote)]);
        assert_eq!(runs, 0x227, "not ready at once: the first ones count");
        assert_eq!(word(&[(true, fault), (false, running), (true, remote)]), 0x208);
        // A stopped drive must not look ready, running or stopping.
        assert_eq!(
            word(&[(false, &[(3, 3)]), (false, &[(3, 1)]), (true, &[(0x400, 0x400)])]),
            0x400
        );
        // A choice that later ones forbid is taken back.
        assert_eq!(word(&[(false, &[(3, 0)]), (false, &[(1, 1)])]), 2);
        assert_eq!(
            word(&[(false, &[(3, 0)]), (false, &[(1, 1)]), (false, &[(2, 2)])]),
            2,
            "the last one is left out"
        );
    }
}
