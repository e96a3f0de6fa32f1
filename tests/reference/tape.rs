//! A reverse-mode tape over f64 whose nodes are matrices: each operation records its value and a hand-written adjoint.
//!
//! For y = f(x) with the loss L, an adjoint is given d_y = ∂L/∂y and adds ∂L/∂x = (∂y/∂x)ᵀ d_y to the gradient of x. Constants take
//! no gradient, and neither does anything that depends on constants alone.

use std::ops::Range;

/// A matrix on the tape. Row-major, `rows * cols` values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Var {
    node: usize,
    pub rows: usize,
    pub cols: usize,
}

impl Var {
    pub fn len(self) -> usize {
        self.rows * self.cols
    }
}

type Adjoint = Box<dyn Fn(&Tape, &[f64], &mut Gradients)>;

struct Node {
    value: Vec<f64>,
    needs_gradient: bool,
    adjoint: Option<Adjoint>,
}

#[derive(Default)]
pub struct Tape {
    nodes: Vec<Node>,
    pub relu_edge: ReluEdge,
}

/// What a ReLU's slope is at its edge: where |Σ w x + b| ≤ margin · (Σ |w x| + |b|). In float32 such a sum may fall on either side of
/// zero, and with it the gradient of all that few samples touch; a test can take both slopes and ask for anything between.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReluEdge {
    pub margin: f64,
    pub slope: f64,
}

/// What [`Tape::backward`] leaves behind: the gradient of every node that the loss depends on.
pub struct Gradients {
    of_node: Vec<Vec<f64>>,
    needed: Vec<bool>,
}

impl Gradients {
    /// The gradient of `var` to be added to, or None where none is wanted.
    pub fn of(&mut self, var: Var) -> Option<&mut [f64]> {
        if !self.needed[var.node] {
            return None;
        }
        let gradient = &mut self.of_node[var.node];
        if gradient.is_empty() {
            gradient.resize(var.len(), 0.0);
        }
        Some(gradient)
    }

    /// The finished gradient; zeros where the loss does not depend on `var`.
    pub fn get(&self, var: Var) -> Vec<f64> {
        let gradient = &self.of_node[var.node];
        if gradient.is_empty() {
            vec![0.0; var.len()]
        } else {
            gradient.clone()
        }
    }
}

impl Tape {
    /// A matrix that no gradient flows into.
    pub fn constant(&mut self, rows: usize, cols: usize, value: Vec<f64>) -> Var {
        self.leaf(rows, cols, value, false)
    }

    /// A matrix whose gradient is wanted.
    pub fn parameter(&mut self, rows: usize, cols: usize, value: Vec<f64>) -> Var {
        self.leaf(rows, cols, value, true)
    }

    fn leaf(&mut self, rows: usize, cols: usize, value: Vec<f64>, needs_gradient: bool) -> Var {
        assert_eq!(
            value.len(),
            rows * cols,
            "a {rows} x {cols} matrix of {} values",
            value.len()
        );
        self.nodes.push(Node {
            value,
            needs_gradient,
            adjoint: None,
        });
        Var {
            node: self.nodes.len() - 1,
            rows,
            cols,
        }
    }

    /// Records the outcome of an operation on `inputs`, and its adjoint.
    pub fn record(
        &mut self,
        rows: usize,
        cols: usize,
        value: Vec<f64>,
        inputs: &[Var],
        adjoint: impl Fn(&Tape, &[f64], &mut Gradients) + 'static,
    ) -> Var {
        let needs_gradient = inputs
            .iter()
            .any(|input| self.nodes[input.node].needs_gradient);
        let var = self.leaf(rows, cols, value, needs_gradient);
        if needs_gradient {
            self.nodes[var.node].adjoint = Some(Box::new(adjoint));
        }
        var
    }

    pub fn value(&self, var: Var) -> &[f64] {
        &self.nodes[var.node].value
    }

    /// Points as a constant `[n, 3]`.
    pub fn points(&mut self, points: &[[f64; 3]]) -> Var {
        self.constant(points.len(), 3, points.as_flattened().to_vec())
    }

    /// Row `row` of a matrix `[n, 3]`.
    pub fn point(&self, x: Var, row: usize) -> [f64; 3] {
        assert_eq!(x.cols, 3);
        std::array::from_fn(|axis| self.value(x)[row * 3 + axis])
    }

    /// The value of a 1 x 1 matrix.
    pub fn scalar(&self, var: Var) -> f64 {
        assert_eq!((var.rows, var.cols), (1, 1));
        self.value(var)[0]
    }

    /// Gradients of the 1 x 1 matrix `loss`.
    pub fn backward(&self, loss: Var) -> Gradients {
        self.backward_with(loss, &vec![1.0; loss.len()])
    }

    /// Gradients of Σ cotangent · output.
    pub fn backward_with(&self, output: Var, cotangent: &[f64]) -> Gradients {
        assert_eq!(cotangent.len(), output.len());
        let mut gradients = Gradients {
            of_node: vec![Vec::new(); self.nodes.len()],
            needed: self.nodes.iter().map(|node| node.needs_gradient).collect(),
        };
        gradients.of_node[output.node] = cotangent.to_vec();
        for index in (0..=output.node).rev() {
            let Some(adjoint) = &self.nodes[index].adjoint else {
                continue;
            };
            if gradients.of_node[index].is_empty() {
                continue;
            }
            let d_output = std::mem::take(&mut gradients.of_node[index]);
            adjoint(self, &d_output, &mut gradients);
            gradients.of_node[index] = d_output;
        }
        gradients
    }

    /// The same value, cut off from what it came from.
    pub fn detach(&mut self, x: Var) -> Var {
        let value = self.value(x).to_vec();
        self.constant(x.rows, x.cols, value)
    }

    /// x with `value` in place of its own: all that depends on it is taken there, and its gradient is x's.
    pub fn moved(&mut self, x: Var, value: Vec<f64>) -> Var {
        assert_eq!(value.len(), x.len());
        self.record(x.rows, x.cols, value, &[x], move |_, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                d_x.iter_mut().zip(d_y).for_each(|(d_x, d_y)| *d_x += d_y);
            }
        })
    }

    /// y = f(x) element by element; `derivative` is given x and y.
    pub fn map(
        &mut self,
        x: Var,
        f: impl Fn(f64) -> f64,
        derivative: impl Fn(f64, f64) -> f64 + 'static,
    ) -> Var {
        let value: Vec<f64> = self.value(x).iter().map(|&x| f(x)).collect();
        let y = Var {
            node: self.nodes.len(),
            ..x
        };
        self.record(x.rows, x.cols, value, &[x], move |tape, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                let values = tape.value(x).iter().zip(tape.value(y));
                for ((d_x, d_y), (&x, &y)) in d_x.iter_mut().zip(d_y).zip(values) {
                    *d_x += d_y * derivative(x, y);
                }
            }
        })
    }

    /// factor · x
    pub fn scale(&mut self, x: Var, factor: f64) -> Var {
        self.map(x, move |x| factor * x, move |_, _| factor)
    }

    /// a + b
    pub fn add(&mut self, a: Var, b: Var) -> Var {
        assert_eq!((a.rows, a.cols), (b.rows, b.cols));
        let value = self
            .value(a)
            .iter()
            .zip(self.value(b))
            .map(|(a, b)| a + b)
            .collect();
        self.record(a.rows, a.cols, value, &[a, b], move |_, d_y, gradients| {
            for input in [a, b] {
                if let Some(d_x) = gradients.of(input) {
                    d_x.iter_mut().zip(d_y).for_each(|(d_x, d_y)| *d_x += d_y);
                }
            }
        })
    }

    /// a · b, element by element.
    pub fn multiply(&mut self, a: Var, b: Var) -> Var {
        assert_eq!((a.rows, a.cols), (b.rows, b.cols));
        let value = self
            .value(a)
            .iter()
            .zip(self.value(b))
            .map(|(a, b)| a * b)
            .collect();
        self.record(
            a.rows,
            a.cols,
            value,
            &[a, b],
            move |tape, d_y, gradients| {
                for (input, other) in [(a, b), (b, a)] {
                    if let Some(d_x) = gradients.of(input) {
                        for ((d_x, d_y), other) in d_x.iter_mut().zip(d_y).zip(tape.value(other)) {
                            *d_x += d_y * other;
                        }
                    }
                }
            },
        )
    }

    /// x Wᵀ for x `[n, inputs]` and W `[outputs, inputs]`.
    pub fn matmul_transposed(&mut self, x: Var, w: Var) -> Var {
        assert_eq!(
            x.cols, w.cols,
            "a layer of {} inputs is given {}",
            w.cols, x.cols
        );
        let (inputs, outputs) = (w.cols, w.rows);
        let mut value = Vec::with_capacity(x.rows * outputs);
        for x_row in self.value(x).chunks_exact(inputs) {
            for w_row in self.value(w).chunks_exact(inputs) {
                value.push(x_row.iter().zip(w_row).map(|(x, w)| x * w).sum());
            }
        }
        self.record(
            x.rows,
            outputs,
            value,
            &[x, w],
            move |tape, d_y, gradients| {
                if let Some(d_x) = gradients.of(x) {
                    for (d_x, d_y) in d_x.chunks_exact_mut(inputs).zip(d_y.chunks_exact(outputs)) {
                        for (w_row, d_y) in tape.value(w).chunks_exact(inputs).zip(d_y) {
                            d_x.iter_mut()
                                .zip(w_row)
                                .for_each(|(d_x, w)| *d_x += d_y * w);
                        }
                    }
                }
                if let Some(d_w) = gradients.of(w) {
                    for (x_row, d_y) in tape
                        .value(x)
                        .chunks_exact(inputs)
                        .zip(d_y.chunks_exact(outputs))
                    {
                        for (d_w, d_y) in d_w.chunks_exact_mut(inputs).zip(d_y) {
                            d_w.iter_mut()
                                .zip(x_row)
                                .for_each(|(d_w, x)| *d_w += d_y * x);
                        }
                    }
                }
            },
        )
    }

    /// xᵀ
    pub fn transpose(&mut self, x: Var) -> Var {
        let (rows, cols) = (x.rows, x.cols);
        let mut value = vec![0.0; x.len()];
        for (i, &x) in self.value(x).iter().enumerate() {
            value[i % cols * rows + i / cols] = x;
        }
        self.record(cols, rows, value, &[x], move |_, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                for (i, d_x) in d_x.iter_mut().enumerate() {
                    *d_x += d_y[i % cols * rows + i / cols];
                }
            }
        })
    }

    /// x + b in every row, for b `[1, cols]`.
    pub fn add_row(&mut self, x: Var, b: Var) -> Var {
        assert_eq!((1, x.cols), (b.rows, b.cols));
        let mut value = self.value(x).to_vec();
        for row in value.chunks_exact_mut(x.cols) {
            row.iter_mut().zip(self.value(b)).for_each(|(y, b)| *y += b);
        }
        self.record(x.rows, x.cols, value, &[x, b], move |_, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                d_x.iter_mut().zip(d_y).for_each(|(d_x, d_y)| *d_x += d_y);
            }
            if let Some(d_b) = gradients.of(b) {
                for row in d_y.chunks_exact(x.cols) {
                    d_b.iter_mut().zip(row).for_each(|(d_b, d_y)| *d_b += d_y);
                }
            }
        })
    }

    /// The rows of x at `indices`, each as often as it is named.
    pub fn gather_rows(&mut self, x: Var, indices: Vec<usize>) -> Var {
        let cols = x.cols;
        let mut value = Vec::with_capacity(indices.len() * cols);
        for &row in &indices {
            value.extend_from_slice(&self.value(x)[row * cols..(row + 1) * cols]);
        }
        self.record(
            indices.len(),
            cols,
            value,
            &[x],
            move |_, d_y, gradients| {
                if let Some(d_x) = gradients.of(x) {
                    for (&row, d_y) in indices.iter().zip(d_y.chunks_exact(cols)) {
                        let d_row = &mut d_x[row * cols..(row + 1) * cols];
                        d_row.iter_mut().zip(d_y).for_each(|(d_x, d_y)| *d_x += d_y);
                    }
                }
            },
        )
    }

    /// Rows `range` of x.
    pub fn rows(&mut self, x: Var, range: Range<usize>) -> Var {
        self.gather_rows(x, range.collect())
    }

    /// Columns `range` of x.
    pub fn columns(&mut self, x: Var, range: Range<usize>) -> Var {
        let width = range.len();
        let value = self
            .value(x)
            .chunks_exact(x.cols)
            .flat_map(|row| row[range.clone()].to_vec())
            .collect();
        self.record(x.rows, width, value, &[x], move |_, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                for (d_row, d_y) in d_x.chunks_exact_mut(x.cols).zip(d_y.chunks_exact(width)) {
                    d_row[range.clone()]
                        .iter_mut()
                        .zip(d_y)
                        .for_each(|(d_x, d_y)| *d_x += d_y);
                }
            }
        })
    }

    /// Matrices of as many rows, side by side.
    pub fn concat(&mut self, parts: &[Var]) -> Var {
        let rows = parts[0].rows;
        let cols = parts.iter().map(|part| part.cols).sum();
        let mut value = Vec::with_capacity(rows * cols);
        for row in 0..rows {
            for part in parts {
                assert_eq!(part.rows, rows);
                value.extend_from_slice(&self.value(*part)[row * part.cols..(row + 1) * part.cols]);
            }
        }
        let parts_kept = parts.to_vec();
        self.record(rows, cols, value, parts, move |_, d_y, gradients| {
            let mut first = 0;
            for &part in &parts_kept {
                if let Some(d_x) = gradients.of(part) {
                    for row in 0..rows {
                        let d_part = &d_y[row * cols + first..][..part.cols];
                        d_x[row * part.cols..][..part.cols]
                            .iter_mut()
                            .zip(d_part)
                            .for_each(|(d_x, d_y)| *d_x += d_y);
                    }
                }
                first += part.cols;
            }
        })
    }

    /// The same values as a matrix of another shape.
    pub fn reshape(&mut self, x: Var, rows: usize, cols: usize) -> Var {
        let value = self.value(x).to_vec();
        let y = self.moved(x, value);
        assert_eq!(y.len(), rows * cols);
        Var { rows, cols, ..y }
    }

    /// Sum over all elements, 1 x 1.
    pub fn sum(&mut self, x: Var) -> Var {
        let value = vec![self.value(x).iter().sum()];
        self.record(1, 1, value, &[x], move |_, d_y, gradients| {
            if let Some(d_x) = gradients.of(x) {
                d_x.iter_mut().for_each(|d_x| *d_x += d_y[0]);
            }
        })
    }
}
