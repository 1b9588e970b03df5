/// A kernel to be compiled for the widest instructions of the machine it runs on.
///
/// It takes `FnMut`, whose call is the closure's own body: `FnOnce`, which [`pulp::Arch::dispatch`]
/// takes, goes through a shim that is compiled for the baseline.
pub(crate) struct Kernel<F>(pub F);

impl<R, F: FnMut() -> R> pulp::WithSimd for Kernel<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}
