//! Counter-based random numbers: a value depends on its address (seed, step, ray, …) alone, not on
//! the order of requests.

/// SplitMix64's finaliser (Steele, Lea and Flood 2014).
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Random numbers of an address, such as (seed, step, ray): the same on any thread.
///
/// ```
/// let mut jitter = volrender::RandomStream::new(&[1, 800, 12]);
/// assert!((0.0..1.0).contains(&jitter.uniform()));
/// ```
#[derive(Clone, Debug)]
pub struct RandomStream(u64);

impl RandomStream {
    /// The stream of an address.
    pub fn new(address: &[u64]) -> Self {
        Self(address.iter().fold(0x9E37_79B9_7F4A_7C15, |state, &word| {
            mix(state.wrapping_mul(0xD134_2543_DE82_EF95).wrapping_add(word).wrapping_add(0x9E37_79B9_7F4A_7C15))
        }))
    }

    /// The next 64 bits.
    #[expect(clippy::should_implement_trait, reason = "the stream does not end")]
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix(self.0)
    }

    /// Uniform in [0, 1), on a grid of 2⁻²⁴.
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in `0..count` (0 for a count of 0).
    pub fn below(&mut self, count: usize) -> usize {
        ((u128::from(self.next()) * count as u128) >> 64) as usize
    }

    /// Standard normal (Box and Muller 1958).
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.uniform()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_numbers_have_the_mean_and_variance_of_the_unit_interval() {
        let mut stream = RandomStream::new(&[1, 2, 3]);
        let values: Vec<f64> = (0..20_000).map(|_| f64::from(stream.uniform())).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        assert!((mean - 0.5).abs() < 0.01, "{mean}");
        assert!((variance - 1.0 / 12.0).abs() < 0.003, "{variance}");
    }

    #[test]
    fn neighbouring_addresses_give_unrelated_streams() {
        let first: Vec<u64> = (0..1000u64).map(|i| RandomStream::new(&[7, i]).next()).collect();
        let mut sorted = first.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), first.len());
        assert_ne!(RandomStream::new(&[1, 2]).next(), RandomStream::new(&[2, 1]).next());
    }

    #[test]
    fn below_stays_below_and_reaches_every_value() {
        let mut stream = RandomStream::new(&[9]);
        let mut seen = [false; 7];
        for _ in 0..500 {
            seen[stream.below(7)] = true;
        }
        assert_eq!(seen, [true; 7]);
        assert_eq!(stream.below(0), 0);
    }
}
