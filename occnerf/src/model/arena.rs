//! One buffer that many segments of samples share, for the backward pass.

use std::ops::Range;

/// Numbers handed out piece by piece. The total of a step is bounded; a buffer for each segment would
/// keep the largest size that its piece ever had.
#[derive(Debug, Default)]
pub(crate) struct Arena {
    buffer: Vec<f32>,
    used: usize,
}

impl Arena {
    /// Takes all pieces back and reserves room for `most` numbers: address space, committed as it is
    /// written, in place of a buffer that grows by copies. A failed reservation falls back to growing.
    pub fn clear(&mut self, most: usize) {
        self.used = 0;
        if self.buffer.capacity() < most {
            let mut roomy = Vec::new();
            if roomy.try_reserve_exact(most).is_ok() {
                self.buffer = roomy;
            }
        }
    }

    /// The next `len` numbers, uninitialised.
    pub fn take(&mut self, len: usize) -> Range<usize> {
        let piece = self.used..self.used + len;
        self.used = piece.end;
        if self.buffer.len() < self.used {
            if self.buffer.capacity() < self.used {
                self.buffer.reserve_exact(self.used + self.used / 8 - self.buffer.len());
            }
            self.buffer.resize(self.used, 0.0);
        }
        piece
    }

    /// A piece that [`Arena::take`] has handed out.
    pub fn piece(&self, piece: &Range<usize>) -> &[f32] {
        &self.buffer[piece.clone()]
    }

    /// [`Arena::piece`], to be written.
    pub fn piece_mut(&mut self, piece: &Range<usize>) -> &mut [f32] {
        &mut self.buffer[piece.clone()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_follow_each_other_and_stay_whatever_room_was_asked_for() {
        let mut arena = Arena::default();
        for (most, lens) in [(0, [3, 0, 5]), (100, [40, 50, 10]), (10, [40, 60, 70]), (usize::MAX, [1, 200, 3])] {
            arena.clear(most);
            let pieces = lens.map(|len| {
                let piece = arena.take(len);
                arena.piece_mut(&piece).fill(len as f32);
                piece
            });
            let mut end = 0;
            for (piece, len) in pieces.iter().zip(lens) {
                assert_eq!(*piece, end..end + len);
                assert!(arena.piece(piece).iter().all(|&x| x == len as f32));
                end += len;
            }
        }
    }
}
