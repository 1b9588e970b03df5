//! Rank statistics.

/// Spearman's rank correlation of two samples of the same length (Spearman 1904): 1 where they
/// agree on the order, −1 where one is the other's reverse; NaN where one of them is constant.
#[must_use]
pub fn spearman(a: &[u64], b: &[u64]) -> f64 {
    assert_eq!(a.len(), b.len(), "spearman: samples of different length");
    pearson(&ranks(a), &ranks(b))
}

/// Ranks from 1; equal values share their mean rank.
#[must_use]
pub fn ranks(values: &[u64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by_key(|&i| values[i]);
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for group in order.chunk_by(|&a, &b| values[a] == values[b]) {
        for &i in group {
            ranks[i] = first as f64 + (group.len() + 1) as f64 / 2.0;
        }
        first += group.len();
    }
    ranks
}

fn pearson(a: &[f64], b: &[f64]) -> f64 {
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(a, b)| f(a - mean_a, b - mean_b)).sum::<f64>();
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_alone_counts_and_ties_share_a_rank() {
        assert_eq!(ranks(&[30, 10, 10, 20]), [4.0, 1.5, 1.5, 3.0]);
        assert!((spearman(&[1, 2, 3, 4], &[10, 100, 101, 10_000]) - 1.0).abs() < 1e-12);
        assert!((spearman(&[1, 2, 3, 4], &[9, 8, 7, 0]) + 1.0).abs() < 1e-12);
        assert!(spearman(&[1, 2, 3, 4], &[2, 1, 4, 3]).abs() < 0.61);
    }
}
