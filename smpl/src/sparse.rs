//! Compressed sparse rows.

/// Compressed sparse rows: the non-zero entries of row i are `columns[offsets[i]..offsets[i + 1]]`,
/// columns ascending, with their `values`.
///
/// ```
/// use smpl::SparseRows;
///
/// let matrix = SparseRows::from_rows([vec![(0, 0.25), (2, 0.75)], vec![]]);
/// assert_eq!(matrix.num_rows(), 2);
/// assert_eq!(matrix.row(0).collect::<Vec<_>>(), [(0, 0.25), (2, 0.75)]);
/// assert_eq!([matrix.heaviest(0), matrix.heaviest(1)], [Some(2), None]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct SparseRows<T> {
    /// Start of each row, and the end of the last: (rows + 1), from 0, not decreasing.
    pub offsets: Vec<u32>,
    /// Column of each entry.
    pub columns: Vec<u32>,
    /// Value of each entry.
    pub values: Vec<T>,
}

impl<T> Default for SparseRows<T> {
    /// No rows.
    fn default() -> Self {
        Self { offsets: vec![0], columns: Vec::new(), values: Vec::new() }
    }
}

impl<T: Copy> SparseRows<T> {
    /// Collects (column, value) pairs, row by row.
    pub fn from_rows(rows: impl IntoIterator<Item = impl IntoIterator<Item = (u32, T)>>) -> Self {
        let mut out = Self::default();
        for row in rows {
            for (column, value) in row {
                out.columns.push(column);
                out.values.push(value);
            }
            out.offsets.push(out.columns.len() as u32);
        }
        out
    }

    /// Number of rows.
    pub fn num_rows(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// The (column, value) pairs of row `row`.
    ///
    /// # Panics
    /// If `row` is out of range.
    #[inline]
    pub fn row(&self, row: usize) -> impl Iterator<Item = (usize, T)> + '_ {
        let range = self.offsets[row] as usize..self.offsets[row + 1] as usize;
        self.columns[range.clone()].iter().zip(&self.values[range]).map(|(&column, &value)| (column as usize, value))
    }

    /// The column of the largest value of row `row`, of equal ones the last; `None` for an empty
    /// row.
    ///
    /// # Panics
    /// If `row` is out of range.
    #[must_use]
    pub fn heaviest(&self, row: usize) -> Option<usize>
    where
        T: Into<f64>,
    {
        self.row(row).max_by(|a, b| a.1.into().total_cmp(&b.1.into())).map(|(column, _)| column)
    }

    /// The first fault of the structure.
    pub(crate) fn fault(&self, rows: usize, columns: usize) -> Option<String> {
        if self.offsets.len() != rows + 1 {
            return Some(format!("{} rows, expected {rows}", self.num_rows()));
        }
        if self.offsets[0] != 0
            || self.offsets.windows(2).any(|w| w[0] > w[1])
            || self.offsets[rows] as usize != self.columns.len()
            || self.columns.len() != self.values.len()
        {
            return Some("row offsets do not partition the entries".to_owned());
        }
        let bad = self.columns.iter().find(|&&c| c as usize >= columns)?;
        Some(format!("column {bad} of {columns}"))
    }
}
