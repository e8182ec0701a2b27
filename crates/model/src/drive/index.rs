//! Index types, so that the compiler notices when one is used in place of another, and the vectors that they index.

use std::fmt;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

use serde::Serialize;

macro_rules! index {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize)]
        #[serde(transparent)]
        pub struct $name(usize);

        impl $name {
            /// The index with this number, from 0.
            pub const fn new(place: usize) -> $name {
                $name(place)
            }

            /// Index of the element as a number, from 0.
            pub const fn place(self) -> usize {
                self.0
            }
        }

        impl From<usize> for $name {
            fn from(place: usize) -> $name {
                $name(place)
            }
        }

        impl From<$name> for usize {
            fn from(index: $name) -> usize {
                index.0
            }
        }

        /// Compares with a plain number, for instance in tests.
        impl PartialEq<usize> for $name {
            fn eq(&self, place: &usize) -> bool {
                self.0 == *place
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }
    };
}

index! {
    /// The index of a drive on its bus, in the order of the file.
    DriveIndex
}

index! {
    /// The index of a point in its profile, in the order of the profile.
    PointIndex
}

/// A list with an element for each drive of a bus.
pub type PerDrive<T> = IndexVec<DriveIndex, T>;

/// A list with an element for each point of a profile.
pub type PerPoint<T> = IndexVec<PointIndex, T>;

/// A vector whose elements are found by an index of one type only; otherwise a slice.
pub struct IndexVec<I, T> {
    elements: Vec<T>,
    index: PhantomData<fn(I)>,
}

impl<I: From<usize> + Into<usize>, T> IndexVec<I, T> {
    /// The element with this index, which must be an index of this vector or of another one for the same drives or points:
    /// all indexes are counted by such a vector, so one that is out of range is a bug, and going on without the element
    /// would hide it. A method and no `Index`, because the lint refuses brackets wherever they are used.
    #[allow(clippy::indexing_slicing)]
    pub fn of(&self, index: I) -> &T {
        &self.elements[index.into()]
    }

    /// The element of that index, to be changed; see [`IndexVec::of`].
    #[allow(clippy::indexing_slicing)]
    pub fn of_mut(&mut self, index: I) -> &mut T {
        &mut self.elements[index.into()]
    }

    /// The element with this index, if there is one.
    pub fn get(&self, index: I) -> Option<&T> {
        self.elements.get(index.into())
    }

    /// The element of that index, to be changed.
    pub fn get_mut(&mut self, index: I) -> Option<&mut T> {
        self.elements.get_mut(index.into())
    }

    /// Each element with its index.
    pub fn enumerate(&self) -> impl DoubleEndedIterator<Item = (I, &T)> + ExactSizeIterator {
        self.elements
            .iter()
            .enumerate()
            .map(|(place, one)| (I::from(place), one))
    }

    /// Each element, mutable, with its index.
    pub fn enumerate_mut(&mut self) -> impl DoubleEndedIterator<Item = (I, &mut T)> + ExactSizeIterator {
        let elements = self.elements.iter_mut().enumerate();
        elements.map(|(place, one)| (I::from(place), one))
    }

    /// All indexes, without borrowing the vector.
    pub fn indexes(&self) -> impl DoubleEndedIterator<Item = I> + ExactSizeIterator + use<I, T> {
        (0..self.elements.len()).map(I::from)
    }

    /// Appends an element.
    pub fn push(&mut self, element: T) {
        self.elements.push(element);
    }

    /// The index of the first element for which `is_wanted` is true.
    pub fn position(&self, is_wanted: impl FnMut(&T) -> bool) -> Option<I> {
        self.elements.iter().position(is_wanted).map(I::from)
    }
}

impl<I, T> Deref for IndexVec<I, T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.elements
    }
}

impl<I, T> DerefMut for IndexVec<I, T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.elements
    }
}

impl<I, T> From<Vec<T>> for IndexVec<I, T> {
    fn from(elements: Vec<T>) -> IndexVec<I, T> {
        IndexVec {
            elements,
            index: PhantomData,
        }
    }
}

impl<I, T> FromIterator<T> for IndexVec<I, T> {
    fn from_iter<E: IntoIterator<Item = T>>(elements: E) -> IndexVec<I, T> {
        Vec::from_iter(elements).into()
    }
}

impl<'v, I, T> IntoIterator for &'v IndexVec<I, T> {
    type Item = &'v T;
    type IntoIter = std::slice::Iter<'v, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.elements.iter()
    }
}

impl<'v, I, T> IntoIterator for &'v mut IndexVec<I, T> {
    type Item = &'v mut T;
    type IntoIter = std::slice::IterMut<'v, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.elements.iter_mut()
    }
}

impl<I, T> Default for IndexVec<I, T> {
    fn default() -> IndexVec<I, T> {
        Vec::new().into()
    }
}

impl<I, T: Clone> Clone for IndexVec<I, T> {
    fn clone(&self) -> IndexVec<I, T> {
        self.elements.clone().into()
    }
}

impl<I, T: PartialEq> PartialEq for IndexVec<I, T> {
    fn eq(&self, other: &IndexVec<I, T>) -> bool {
        self.elements == other.elements
    }
}

impl<I, T: fmt::Debug> fmt::Debug for IndexVec<I, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.elements.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_found_by_their_index() {
        let mut names: PerDrive<&str> = vec!["pump", "fan", "fan"].into();
        let fan = names.position(|name| *name == "fan").unwrap();
        assert_eq!((fan, fan.place()), (DriveIndex::new(1), 1));
        assert_eq!(names.enumerate().last(), Some((DriveIndex::new(2), &"fan")));
        assert!(names.indexes().eq([0, 1, 2].map(DriveIndex::new)));
        *names.get_mut(fan).unwrap() = "mixer";
        for (index, name) in names.enumerate_mut().filter(|(index, _)| *index == 0) {
            assert_eq!((format!("{index:?}").as_str(), *name), ("0", "pump"));
            *name = "saw";
        }
        assert_eq!((names.get(fan), names.get(DriveIndex::new(3))), (Some(&"mixer"), None));
        assert_eq!(*names, ["saw", "mixer", "fan"]);
    }
}
